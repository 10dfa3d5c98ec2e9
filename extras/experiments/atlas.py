"""The failure atlas: where each pilot fails, and why.

    extras/.venv/bin/python -m extras.experiments.atlas      # both processors, a quarter of an hour

Draws figures/atlas.png, the share of episodes that cross in forests from half to twice as dense and
at speeds from 2 to 8 m/s, by the imitated pilots of both worlds, the laser pilot and chance. Denser
means that the same grid, jitter included, is drawn smaller and has more trunks. Nothing was trained
in any but density 1 at 5 m/s. Then lists those of 500 forests in the world of the beacon where
weights/imitation-beacon.pt did not arrive, crashes first and the shortest progress first, each with
a word:

    unseen    the trunk was outside the last four frames
    trapped   a second before the crash, each of the nine yaw rates, kept, crashed within 1.5 s
    careless  a second before, some yaw rate would have done
    far, side, back, time    no crash: it left by that edge, or flew in circles

Writes results/atlas.json. Film one of them: `deepflight.py eval --weights
weights/imitation-beacon.pt --episodes 1 --first-seed SEED`.
"""

import json
import math
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch

from deepflight import Config, dqn_pilot, load_weights, measure
from env import Drone, Episode, Pilot, World, fly, random_pilot
from extras.lessons.expert import laser_pilot
from render import seen_from

ROOT = Path(__file__).parents[2]
DENSITIES, SPEEDS = (0.5, 0.75, 1.0, 1.5, 2.0), (2.0, 3.5, 5.0, 6.5, 8.0)  # times, m/s
PILOTS = ("imitation", "imitation, beacon", "laser", "random")
FIRST, FORESTS, WORST_OF = 2 * 10**9, 50, 500  # no training or validation plants these


def forest(density: float, speed: float, beacon: bool) -> World:
    """The same forest drawn smaller: trunks a square metre, times `density`."""
    shrink, w = math.sqrt(density), World()
    grid = tuple(round(n * shrink) for n in w.grid)
    spacing, jitter = (tuple(x / shrink for x in pair) for pair in (w.spacing, w.jitter))  # m
    first = w.first[0], -spacing[1] * (grid[1] - 1) / 2 + 0.5  # m, off centre as ever
    size = {"grid": grid, "first": first, "spacing": spacing, "jitter": jitter}
    return World(speed=speed, beacon=beacon, **size)


def pilot(name: str) -> Pilot:
    """By name."""
    if name == "laser":
        return laser_pilot(Config.gamma)
    if name == "random":
        return random_pilot(np.random.default_rng(0))
    return dqn_pilot(load_weights(ROOT / f"weights/{name.replace(', ', '-')}.pt")[0])


def episodes(job: tuple[str, float, float, int]) -> list[Episode]:
    """Of one pilot at one density and speed, through so many forests."""
    name, density, speed, count = job
    torch.set_num_threads(1)
    world = forest(density, speed, name.endswith("beacon"))
    blind = not name.startswith("imitation")
    return fly(pilot(name), range(FIRST, FIRST + count), world, blind=blind)


def at(episode: Episode, world: World, steps: int) -> Drone:
    """The drone of an episode, flown again that far."""
    drone = Drone(world)
    drone.reset(episode["seed"])
    for action in episode["actions"][:steps]:
        drone.step(int(action))
    return drone


def doomed(drone: Drone, action: int) -> bool:
    """Whether this yaw rate, kept for 1.5 s, crashes."""
    for _ in range(15):
        drone.step(action)
        if drone.outcome:
            return drone.outcome == "crash"
    return False


def seen(drone: Drone, trunk: np.ndarray) -> bool:
    """Whether any of the trunk is within the frame's 90 degrees."""
    ahead, left = seen_from(np.array(drone.pose), trunk)  # m
    margin = math.sqrt(2) * drone.world.trunk_radius  # m along x and y to where it is out of view
    return abs(left) < ahead + margin


def cause(episode: Episode, world: World) -> str:
    """Of the episode's end, in a word."""
    if episode["outcome"] != "crash":
        return episode["outcome"]
    end = at(episode, world, episode["steps"])
    trunk = min(end.trunks, key=lambda centre: math.dist(centre, end.pose[:2]))
    last = range(max(episode["steps"] - 4, 0), episode["steps"])
    if not any(seen(at(episode, world, steps), trunk) for steps in last):
        return "unseen"
    before = max(episode["steps"] - 10, 0)
    ways = (doomed(at(episode, world, before), action) for action in range(world.num_actions))
    return "trapped" if all(ways) else "careless"


def draw(table: dict[str, list[list[float]]]) -> None:
    """One panel a pilot: densities upwards, speeds to the right."""
    figure, panels = plt.subplots(1, len(table), figsize=(13, 3.6), layout="constrained")
    for axes, (name, shares) in zip(panels, table.items(), strict=True):
        axes.imshow(shares, origin="lower", vmin=0, vmax=1, cmap="RdYlGn")
        for (i, j), share in np.ndenumerate(shares):
            axes.text(j, i, f"{100 * share:.0f}", ha="center", va="center")
        axes.set_xticks(range(len(SPEEDS)), SPEEDS)
        axes.set_yticks(range(len(DENSITIES)), DENSITIES)
        axes.set(title=f"{name}: crossed, %", xlabel="speed, m/s", ylabel="trunks, times 150")
    figure.savefig(ROOT / "figures/atlas.png", dpi=100)


def main() -> None:
    """Fly everything, draw it, write it."""
    cells = list(product(PILOTS, DENSITIES, SPEEDS))
    with ProcessPoolExecutor(2) as pool:
        flown = pool.map(episodes, [(*cell, FORESTS) for cell in cells])
        shares = [measure(x)["crossed"].mean() for x in flown]
    shape = (len(PILOTS), len(DENSITIES), len(SPEEDS))
    table = dict(zip(PILOTS, np.reshape(shares, shape).tolist(), strict=True))
    draw(table)
    world, flown = World(beacon=True), episodes(("imitation, beacon", 1.0, 5.0, WORST_OF))
    failed = [e for e in flown if e["outcome"] != "goal"]
    failed.sort(key=lambda e: (e["outcome"] != "crash", e["progress"]))
    worst = [{"cause": cause(e, world)} | e for e in failed]
    for e in worst:
        print("{cause:8} {steps:4} steps, progress {progress:.1f} m: forest {seed}".format(**e))
    report = {"forests": FORESTS, "densities": DENSITIES, "speeds": SPEEDS, "crossed": table}
    report |= {"first_seed": FIRST, "worst_of": WORST_OF, "worst": worst}
    (ROOT / "results/atlas.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
