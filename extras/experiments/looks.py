"""Which pilot flies on when the world looks different? Grey against disparity [DF §IV].

    .venv/bin/python -m extras.experiments.looks train   # half an hour, two trainings at a time
    .venv/bin/python -m extras.experiments.looks fly     # ten minutes
    .venv/bin/python -m extras.experiments.looks draw
    .venv/bin/python -m extras.experiments.looks time    # leave the machine alone: half a minute

A look changes what the camera delivers, and leaves every trunk where it is. LOOKS change a grey
frame: the paint, the light, the air, the lens, the sensor. In our disparity only the air counts,
because haze ends its view too. All else is left out of it: disparity is a matter of geometry.
STEREO is what a stereo camera gets wrong instead. The paint of a trunk is uniform, so a matcher
finds its two edges and guesses between them: that is where holes are.

Four imitated pilots fly each look through the same 200 forests: the shipped ones of plain grey and
plain disparity, and two whose training drew a look for each forest at random, from wider ranges
than the looks that are flown. `train` makes these two, in runs/looks-grey and runs/looks-disparity.
`fly` writes results/transfer.json, with paired intervals: the same forests, drawn again 2,000
times. `draw` draws figures/transfer.png. `time` compares how long a frame of either camera takes.

A look is a function of forest and pose alone, noise included. So an episode stays its seed and its
actions, and an interrupted training can go on.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy import ndarray
from numpy.random import Generator
from PIL import Image, ImageDraw

import deepflight
import env
from deepflight import dqn_pilot, fly_random, interval, load, load_weights, measure, summarize
from env import Episode, World, fly, plant
from extras.lessons import expert
from render import CAMERAS, PIXELS, SLOPES, Scene, background, draw_frames, shade

ROOT = Path(__file__).parents[2]
RESULT, FIGURE = ROOT / "results/transfer.json", ROOT / "figures/transfer.png"
FORESTS = range(6 * 10**9, 6 * 10**9 + 200)
STEREO_PIXEL = 13  # levels of disparity in one pixel of a 640-pixel pair with a 12 cm baseline:
# its focal length is 320 px, so a point at depth z is shifted by 38.4 / z px; we write 510 / z


@dataclass(frozen=True)
class Look:
    """What a camera makes of the same forest. Levels are those of a frame, 0 to 255."""

    scene: dict[str, Any] = field(default_factory=dict)  # fields of render.Scene
    stripes: float = 0.0  # m, the height of a bright ring of bark, and of the dark one above it
    gain: float = 1.0  # by which light is multiplied
    vignette: float = 0.0  # the share of light that is lost in the corners
    blur: bool = False  # the mean of 3x3 pixels
    noise: float = 0.0  # levels, standard deviation, in every pixel of a grey frame
    error: float = 0.0  # the same of disparity: in depth the error grows with the depth's square
    holes: float = 0.0  # the share of 4x4 blocks in a trunk that a matcher finds no depth for
    filled: bool = False  # a hole gets the last depth to its left, and not 0
    quantum: int = 1  # levels between two depths that a matcher can tell apart
    fat: int = 0  # px by which an edge is too far to the right, and twice that to the left


LOOKS = {
    "plain": Look(),
    "bright bark": Look({"trunk_facing": 220, "trunk_grazing": 150}),
    "striped bark": Look(stripes=0.5),
    "no haze": Look({"view": 1000.0}),
    "thick haze": Look({"view": 15.0}),
    "bright sky": Look({"sky": 220}),
    "dusk": Look(gain=0.35),
    "ground dark as bark": Look({"ground": 20}),
    "vignette": Look(vignette=0.8),
    "blur": Look(blur=True),
    "sensor noise": Look(noise=12.0),
}
STEREO = {
    "depth noise": Look(error=4.0),
    "holes": Look(holes=0.5),
    "holes, filled": Look(holes=0.5, filled=True),
    "whole steps": Look(quantum=STEREO_PIXEL),
    "shifted edges": Look(fat=1),
    "all together": Look(error=4.0, holes=0.5, filled=True, quantum=STEREO_PIXEL, fat=1),
}
PILOTS = {  # name -> camera, weights
    "grey": ("grey", ROOT / "weights/imitation.pt"),
    "grey, random looks": ("grey", ROOT / "runs/looks-grey/best.pt"),
    "disparity": ("disparity", ROOT / "weights/imitation-disparity.pt"),
    "disparity, random noise": ("disparity", ROOT / "runs/looks-disparity/best.pt"),
}
CHANGES = {  # metric -> its name in `measure`; is it counted in mean episodes of random?
    "crossed": ("crossed", False), "crash": ("crash", False), "longer": ("steps", True),
}  # fmt: skip
Trunks = Sequence[ndarray]
Seeing = Callable[..., ndarray]  # like render.draw_frames
COLUMNS, TILE = 5, (174, 212)  # of the drawing; px
POSE = np.array([[43.0, -12.85, 0.19]])  # where it is taken: x, y in m, heading in rad


# -------------------------------------------------- looks


def wear(look: Look, poses: ndarray, trunks: Trunks, scene: Scene, *beacon: Any) -> ndarray:
    """What render.draw_frames draws, in this look: (E, 84, 84) uint8."""
    scene = replace(scene, **look.scene) if look.scene else scene
    frames = draw_frames(poses, trunks, scene, *beacon)  # (E, 84, 84)
    if look.stripes and scene.camera == "grey":
        frames = ringed(frames, look, scene, draw_frames(poses, trunks, stereo(scene), *beacon))
    change = mismatch if scene.camera == "disparity" else expose
    rngs = [np.random.default_rng(np.abs([*pose, *wood[:1].ravel()]).view(np.uint32))
            for pose, wood in zip(poses, trunks, strict=True)]  # fmt: skip
    changed = [change(frame, look, scene, rng) for frame, rng in zip(frames, rngs, strict=True)]
    return np.clip(np.rint(changed), 0, 255).astype(np.uint8)  # (E, 84, 84)


def stereo(scene: Scene) -> Scene:
    """The same, seen by a stereo camera."""
    return replace(scene, camera="disparity")


def ringed(frames: ndarray, look: Look, scene: Scene, seen: ndarray) -> ndarray:
    """Paint bright rings on the trunks. seen: the disparity of the same view, (E, 84, 84)."""
    trunk = seen > background(stereo(scene))  # (E, 84, 84)
    depth = 255 * scene.near / np.maximum(seen, 1)  # (E, 84, 84) m
    height = scene.altitude + SLOPES[:, None] * depth  # (E, 84, 84) m above the ground
    ring = trunk & (np.floor(height / look.stripes) % 2 == 0)  # (E, 84, 84)
    return np.where(ring, shade(200, depth, depth, scene), frames)


def expose(frame: ndarray, look: Look, _scene: Scene, rng: Generator) -> ndarray:
    """Light, lens and sensor of a grey frame (84, 84)."""
    grey = frame * look.gain * (1 - look.vignette * (SLOPES**2 + SLOPES[:, None] ** 2) / 2)
    if look.blur:
        wide = np.pad(grey, 1, mode="edge")  # (86, 86)
        rows = wide[:-2] + wide[1:-1] + wide[2:]  # (84, 86)
        grey = (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9  # (84, 84)
    return grey + static(look.noise, rng)


def static(deviation: float, rng: Generator) -> ndarray:
    """Noise (84, 84) of this standard deviation, each pixel by itself."""
    return deviation * rng.standard_normal((PIXELS, PIXELS), np.float32)


def mismatch(frame: ndarray, look: Look, scene: Scene, rng: Generator) -> ndarray:
    """What a matcher gets wrong in a frame of disparity (84, 84)."""
    seen = frame.astype(float)
    if look.fat:  # the nearer side of an edge grows
        padded = np.pad(seen, ((0, 0), (look.fat, 2 * look.fat)))
        shifted = [padded[:, i : i + PIXELS] for i in range(3 * look.fat + 1)]
        seen = np.maximum.reduce(shifted)  # (84, 84)
    if look.holes:
        trunk = seen > background(scene)  # (84, 84)
        inside = trunk & np.roll(trunk, 1, 1) & np.roll(trunk, -1, 1)  # (84, 84) not the two edges
        blocks = rng.random((21, 21)) < look.holes
        hole = inside & np.kron(blocks, np.ones((4, 4), bool))  # (84, 84)
        last = np.maximum.accumulate(np.where(hole, 0, np.arange(84)), 1)  # (84, 84) no hole
        seen = np.take_along_axis(seen, last, 1) if look.filled else np.where(hole, 0, seen)
    seen = seen + static(look.error, rng) * (seen > 0)
    return np.floor(seen / look.quantum) * look.quantum


def draw_look(kind: str, rng: Generator) -> Look:
    """A look at random, from ranges that hold all of LOOKS, or of STEREO."""

    def maybe(most: float) -> float:
        return rng.integers(2) * rng.uniform(0, most)

    if kind == "disparity":
        spoilt = {"error": maybe(6), "holes": maybe(0.7), "filled": bool(rng.integers(2))}
        quantum = 1 + round(maybe(16))
        return Look(**spoilt, quantum=quantum, fat=int(rng.integers(2)))
    facing = rng.integers(256)
    paint = {"sky": int(rng.integers(20, 251)), "ground": int(rng.integers(251))}
    paint |= {"trunk_facing": int(facing), "trunk_grazing": int(facing * rng.uniform(0, 1))}
    paint |= {"view": float(rng.choice([rng.uniform(12, 60), 1000.0], p=[0.8, 0.2]))}
    lens = {"gain": rng.uniform(0.3, 1.2), "vignette": maybe(1), "blur": bool(rng.integers(2))}
    stripes = maybe(1.5)
    return Look(paint, noise=maybe(15), stripes=max(stripes, 0.2) if stripes else 0.0, **lens)


def wear_at_random(poses: ndarray, trunks: Trunks, scene: Scene, *beacon: Any) -> ndarray:
    """Each drone in a look of its forest: (E, 84, 84) uint8."""
    frames = []
    for pose, wood in zip(poses, trunks, strict=True):
        rng = np.random.default_rng(np.abs(wood[0]).view(np.uint32))  # a function of the forest
        frames.append(wear(draw_look(scene.camera, rng), pose[None], [wood], scene, *beacon))
    return np.concatenate(frames)


@contextmanager
def seeing(see: Seeing) -> Iterator[None]:
    """Give every drone these eyes."""
    plain, env.draw_frames = env.draw_frames, see
    try:
        yield
    finally:
        env.draw_frames = plain


# -------------------------------------------------- train, fly


def train(kind: str) -> int:
    """Imitate the expert in forests that each have a look of their own, or go on with it."""
    folder = ROOT / f"runs/looks-{kind}"
    if trained(folder / "best.pt"):
        return 0
    words = ["--name", folder.name, "--camera", kind]
    if (folder / "checkpoint.pt").exists():
        words = ["--resume", str(folder)]
    with seeing(wear_at_random):
        return deepflight.main(["train", *words], expert.ExpertConfig)


def trained(weights: Path) -> bool:
    """Whether these weights are shipped, or those of a training that has come to its end."""
    checkpoint = weights.with_name("checkpoint.pt")
    if not checkpoint.exists():
        return weights.exists()
    saved = load(checkpoint, "config", "actions")
    return len(saved["actions"]) * saved["config"]["num_envs"] >= saved["config"]["steps"]


def train_all() -> None:
    """Both, side by side."""
    line = [sys.executable, "-m", "extras.experiments.looks", "train"]
    running = [subprocess.Popen([*line, kind], cwd=ROOT) for kind in CAMERAS]
    if any(process.wait() for process in running):
        sys.exit("looks: a training failed")


def flown(pilot: str, look: str) -> list[Episode]:
    """This pilot's episodes, in this look."""
    torch.set_num_threads(1)
    q, world, _ = load_weights(PILOTS[pilot][1])
    with seeing(partial(wear, (LOOKS | STEREO)[look])):
        return fly(dqn_pilot(q), FORESTS, world)


def fly_all() -> None:
    """Every pilot that is trained and not yet flown, in every look of its camera."""
    report, baseline = reported(), fly_random(FORESTS, World())
    draws = np.random.default_rng(0).integers(len(FORESTS), size=(2000, len(FORESTS)))
    for pilot, (kind, path) in PILOTS.items():
        if pilot in report or not trained(path):
            continue
        looks = list(LOOKS if kind == "grey" else LOOKS | STEREO)
        with ProcessPoolExecutor(2) as pool:
            episodes = dict(zip(looks, pool.map(flown, [pilot] * len(looks), looks), strict=True))
        report[pilot] = {
            look: compare(episodes[look], episodes["plain"], baseline, draws) for look in looks
        }
        RESULT.write_text(json.dumps(report, indent=1) + "\n")
        for look, found in report[pilot].items():
            said = [f"{key} {found[key]['value']:.3f}" for key in (*CHANGES, "return")]
            print(f"{pilot}, {look}:", *said, flush=True)


def reported() -> dict[str, dict]:
    """What has been flown: pilot -> look -> metric, and under "change" what the look changes."""
    return json.loads(RESULT.read_text()) if RESULT.exists() else {}


def compare(
    episodes: list[Episode], plain: list[Episode], baseline: list[Episode], draws: ndarray
) -> dict[str, dict]:
    """What `eval` would say of these episodes, and the change from plain, forest by forest."""
    found, changes = summarize(episodes, baseline, draws), {}
    a, b, per = measure(episodes), measure(plain), measure(baseline)["steps"].mean()
    for key, (metric, relative) in CHANGES.items():
        change = (a[metric].astype(float) - b[metric]) / (per if relative else 1)  # (F,)
        changes[key] = interval(change.mean(), change[draws].mean(1))
    return found | {"change": changes}


# -------------------------------------------------- the drawing


def draw() -> None:
    """A tile a look: what the network sees, and how many of its episodes cross."""
    report = reported()
    hazes = {name: look for name, look in LOOKS.items() if "view" in look.scene}
    parts = (("grey", LOOKS), ("disparity", {"plain": Look(), **hazes} | STEREO))
    tiles = [(kind, name, look) for kind, looks in parts for name, look in looks.items()]
    rows = -(-len(tiles) // COLUMNS)
    image = Image.new("RGB", (COLUMNS * TILE[0], rows * TILE[1]), "white")
    for i, (kind, name, look) in enumerate(tiles):
        shares = [f"{100 * report[p][name]['crossed']['value']:.0f}" for p in PILOTS
                  if PILOTS[p][0] == kind]  # fmt: skip
        x, y = i % COLUMNS * TILE[0], i // COLUMNS * TILE[1]
        frame = wear(look, POSE, [plant(FORESTS[0], World())], World(camera=kind))[0]
        image.paste(Image.fromarray(frame).resize((168, 168), Image.Resampling.NEAREST), (x, y))
        words = f"{kind}: {name}\ncrossed {' / '.join(shares)} %"
        ImageDraw.Draw(image).text((x + 2, y + 170), words, fill="black", font_size=14)
    image.save(FIGURE, optimize=True)
    print(f"wrote {FIGURE.relative_to(ROOT)}")


def time_both() -> None:
    """How long eight frames of disparity take, as a share of eight grey ones; in turn."""
    rng, worlds = np.random.default_rng(0), [World(camera=kind) for kind in CAMERAS]
    trunks = [plant(seed, worlds[0]) for seed in range(8)]
    taken = np.zeros((200, 2))  # s
    for row in taken:
        poses = rng.uniform((0, -20, -1), (80, 20, 1), (50, 8, 3))  # (50, 8, 3)
        for i, world in enumerate(worlds):
            start = time.perf_counter()
            for eight in poses:
                draw_frames(eight, trunks, world)
            row[i] = time.perf_counter() - start
    ratio = np.median(taken[:, 1] / taken[:, 0])
    print(f"disparity / grey {ratio:.2f}; eight grey frames {taken[:, 0].min() * 20:.2f} ms")


def main() -> int | None:
    """One of the four commands."""
    commands = {"train": train_all, "fly": fly_all, "draw": draw, "time": time_both}
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("command", choices=commands)
    parser.add_argument("camera", nargs="?", choices=CAMERAS, help="train this pilot alone")
    args = parser.parse_args()
    return train(args.camera) if args.camera else commands[args.command]()


if __name__ == "__main__":
    sys.exit(main())
