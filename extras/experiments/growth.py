"""A pilot grows: what a training flew in validation at four moments.

    .venv/bin/python -m extras.experiments.growth             draws figures/growth.png and .gif
    .venv/bin/python -m extras.experiments.growth runs/001    draws both into that folder

It needs no weights: validation.jsonl in the folder of a training has every validation episode, and
seed and actions are all it takes to fly one again. growth.png: all ways at each moment. growth.gif:
the first forest that the last network crosses, flown by all four, twice as fast as life.
"""

import csv
import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from env import OUTCOMES, Drone, World, refly
from extras.experiments.maps import COLOURS, HOLLOW, draw_map, draw_ways

ROOT = Path(__file__).parents[2]
SHARES = 0.025, 0.075, 0.25, 1.0  # of the training's length, at which the four moments are
ENDS = {"": "in the air", "crash": "hit a trunk", "goal": "arrived", "time": "out of time"}
ENDS |= {"far": "crossed at the far edge", "side": "left by a side", "back": "left by the back"}


def read(folder: Path) -> tuple[World, dict[str, list[dict]]]:
    """The world, and for each of four moments a title and the episodes flown then."""
    if not (folder / "validation.jsonl").exists():
        sys.exit(f"growth: {folder} is no folder of a training that has validated")
    config = json.loads((folder / "config.json").read_text())
    with (folder / "log.csv").open() as file:
        minutes = {int(row["step"]): float(row["seconds"]) / 60 for row in csv.DictReader(file)}
    last, kept = max(minutes), {}
    for line in (folder / "validation.jsonl").read_text().splitlines():
        episode = json.loads(line)
        kept.setdefault(episode.pop("step"), []).append(episode)
    moments = sorted({min(minutes, key=lambda step: abs(step - share * last)) for share in SHARES})
    titles = {step: f"after {step:,} steps, {minutes[step]:.0f} min" for step in moments}
    world = World(beacon=config["beacon"], camera=config["camera"])
    return world, {titles[step]: kept[step] for step in moments}


def sheet(panels: list[Image.Image]) -> Image.Image:
    """Two panels a row."""
    width, height = panels[0].size
    image = Image.new("RGB", (2 * width + 8, -(-len(panels) // 2) * (height + 8) - 8), "white")
    for i, panel in enumerate(panels):
        image.paste(panel, (i % 2 * (width + 8), i // 2 * (height + 8)))
    return image


def headed(picture: Image.Image, title: str) -> Image.Image:
    """A panel: a line of text above a picture."""
    panel = Image.new("RGB", (picture.width, picture.height + 22), "white")
    panel.paste(picture, (0, 22))
    ImageDraw.Draw(panel).text((2, 2), title, fill="black", font_size=15)
    return panel


def path(episode: dict, world: World) -> np.ndarray:
    """The places (T, 2) in m that an episode went through."""
    return np.array([drone.pose[:2] for drone in refly(episode, world)])


def all_ways(title: str, episodes: list[dict], world: World) -> Image.Image:
    """Every way of a moment on one map; the trunks differ, and are left out."""
    plain = draw_map(np.empty((0, 2)), (world.length, world.width))
    image = draw_ways(plain, [(path(e, world), e["outcome"], "") for e in episodes])
    panel = headed(image.resize((480, 265)), title)
    draw, x = ImageDraw.Draw(panel), 20.0
    for end in OUTCOMES:
        if count := sum(episode["outcome"] == end for episode in episodes):
            text = f"{count} {ENDS[end]}"
            inside = "white" if end in HOLLOW else COLOURS[end]
            draw.circle((x + 5, 29), 5, inside, COLOURS[end], 2)
            draw.text((x + 13, 21), text, fill="black", font_size=12)
            x += draw.textlength(text, font_size=12) + 21
    return panel


def moment(drone: Drone, way: np.ndarray, title: str, world: World) -> Image.Image:
    """A panel of the film: the drone's newest frame, and its way so far."""
    plain = draw_map(drone.trunks, (world.length, world.width))
    picture = Image.new("RGB", (480, 168), "white")
    picture.paste(Image.fromarray(drone.observation[-1]).resize((168, 168), 0))  # not smoothed
    picture.paste(draw_ways(plain, [(way, drone.outcome, "")]).resize((304, 168)), (176, 0))
    return headed(picture, f"{title}: {ENDS[drone.outcome]}")


def film(flown: dict[str, dict], world: World) -> list[Image.Image]:
    """The pictures of the film; each episode holds its last one until the longest has ended."""
    panels = []
    for title, episode in flown.items():
        way, pictures = [], []
        for t, drone in enumerate(refly(episode, world)):
            way.append(drone.pose[:2])
            if t % 2 == 0 or drone.outcome:
                pictures.append(moment(drone, np.array(way), title, world))
        panels.append(pictures)
    longest = max(map(len, panels)) + 30
    shown = ([panel[min(t, len(panel) - 1)] for panel in panels] for t in range(longest))
    return [sheet(pictures).quantize(32, Image.Quantize.FASTOCTREE) for pictures in shown]


def main(folder: Path, out: Path) -> None:
    """Draw the picture and the film of a training."""
    world, kept = read(folder)
    sheet([all_ways(*one, world) for one in kept.items()]).save(out / "growth.png")
    *_, last = kept.values()
    shown = next((i for i, e in enumerate(last) if e["outcome"] in ("goal", "far")), 0)
    first, *rest = film({title: episodes[shown] for title, episodes in kept.items()}, world)
    first.save(out / "growth.gif", save_all=True, append_images=rest, duration=100, loop=0)
    print(f"wrote {out / 'growth.png'} and {out / 'growth.gif'}: forest {last[shown]['seed']}")


if __name__ == "__main__":
    given = Path(sys.argv[1]) if sys.argv[1:] else ROOT / "results/dqn"
    main(given, given if sys.argv[1:] else ROOT / "figures")
