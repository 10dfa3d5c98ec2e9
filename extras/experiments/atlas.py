"""The failure atlas: where each pilot fails, and why.

    extras/.venv/bin/python -m extras.experiments.atlas      # both processors, a quarter of an hour

Draws figures/atlas.png, the share of flights that cross for forests from half to twice as dense
and speeds from 2 to 8 m/s, by the camera pilot in either world, the laser pilot and chance. Denser
means that the same grid, jitter included, is drawn smaller and has more trunks. Nothing was trained
in any but density 1 at 5 m/s. Then lists those of the first 500 evaluation forests in the world of
the beacon where the camera pilot did not arrive, crashes first and the shortest progress first,
each with a word:

    unseen    the trunk was outside the picture in the last four frames
    trapped   a second before the crash, each of the nine yaw rates, kept, crashed within 1.5 s
    careless  a second before, some yaw rate would have done
    side, back, time    no crash: it left by that edge, or flew in circles

Writes results/atlas.json. Fly a forest of it: `deepflight.py eval --beacon --episodes 1
--first-seed SEED`.
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

from deepflight import EVAL_FIRST, cockpit, dqn_pilot
from dqn import DQNConfig, load_weights
from env import (
    Flights,
    ForestEnv,
    Pilot,
    World,
    fly,
    laser_pilot,
    measure,
    random_pilot,
)

ROOT = Path(__file__).parents[2]
DENSITIES, SPEEDS = (0.5, 0.75, 1.0, 1.5, 2.0), (2.0, 3.5, 5.0, 6.5, 8.0)  # times, m/s
PILOTS = ("camera", "camera, beacon", "laser", "random")
FORESTS, WORST_OF = 50, 500


def forest(density: float, speed: float, beacon: bool) -> World:
    """The same forest drawn smaller: trunks a square metre, times `density`."""
    shrink, w = math.sqrt(density), World()
    rows, columns = round(w.rows * shrink), round(w.columns * shrink)
    x, y = w.spacing_x / shrink, w.spacing_y / shrink  # m
    first_y = -y * (columns - 1) / 2 + 0.5  # m, off centre as ever
    jitter = {"jitter_x": w.jitter_x / shrink, "jitter_y": w.jitter_y / shrink}
    size = {"rows": rows, "columns": columns, "spacing_x": x, "spacing_y": y, "first_y": first_y}
    return World(speed=speed, beacon=beacon, **size, **jitter)


def pilot(name: str) -> Pilot:
    """By name."""
    if name == "laser":
        return laser_pilot(DQNConfig.gamma)
    if name == "random":
        return random_pilot(np.random.default_rng(0))
    beacon = name.endswith("beacon")
    file = ROOT / f"weights/{'beacon' if beacon else 'paper'}.pt"
    return dqn_pilot(load_weights(file, World.actions, beacon=beacon, camera="grey"))


def flights(job: tuple[str, float, float, int]) -> Flights:
    """Of one pilot at one density and speed, through so many forests."""
    name, density, speed, count = job
    torch.set_num_threads(1)
    seeds = range(EVAL_FIRST, EVAL_FIRST + count)
    world = forest(density, speed, name.endswith("beacon"))
    return fly(pilot(name), seeds, world, blind=not name.startswith("camera"))


def doomed(env: ForestEnv, action: int) -> bool:
    """Whether this yaw rate, kept for 1.5 s, crashes."""
    for _ in range(15):
        env.step(action)
        if env.outcome:
            return env.outcome == "crash"
    return False


def at(flight: dict, world: World, steps: int) -> ForestEnv:
    """The flight, flown again that far."""
    env = ForestEnv(world, blind=True)
    env.reset(seed=flight["seed"])
    for action in flight["actions"][:steps]:
        env.step(int(action))
    return env


def seen(env: ForestEnv, trunk: np.ndarray) -> bool:
    """Whether any of the trunk is within the picture's 90 degrees."""
    ahead, left = (trunk - env.drone.position) @ np.array(
        [env.drone.rotation_vector, env.drone.rotation_vector.perpendicular()]
    ).T  # m
    margin = math.sqrt(2) * env.world.trunk_radius  # m, along x and y to where bark is out of view
    return abs(left) < ahead + margin


def cause(flight: dict, world: World) -> str:
    """Of the flight's end, in a word."""
    if flight["outcome"] != "crash":
        return flight["edge"] or flight["outcome"]
    end = at(flight, world, flight["steps"])
    trunk = min(end.trunks, key=lambda centre: math.dist(centre, end.drone.position))
    last = range(max(flight["steps"] - 4, 0), flight["steps"])
    if not any(seen(at(flight, world, steps), trunk) for steps in last):
        return "unseen"
    before = max(flight["steps"] - 10, 0)
    ways = (at(flight, world, before) for _ in range(world.actions))
    return "trapped" if all(doomed(env, a) for a, env in enumerate(ways)) else "careless"


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
        flown = pool.map(flights, [(*cell, FORESTS) for cell in cells])
        shares = [measure(x)["crossed"].mean() for x in flown]
    shape = (len(PILOTS), len(DENSITIES), len(SPEEDS))
    table = dict(zip(PILOTS, np.reshape(shares, shape).tolist(), strict=True))
    draw(table)
    world, flown = World(beacon=True), flights(("camera, beacon", 1.0, 5.0, WORST_OF))
    failed = [f for f in flown if f["outcome"] != "goal"]
    failed.sort(key=lambda f: (f["outcome"] != "crash", f["progress"]))
    worst = [{"seed": f["seed"], "cause": cause(f, world)} | f for f in failed]
    for f in worst:
        print(f"{f['cause']:8} {f['steps']:4} steps, progress {f['progress']:.1f} m:", end=" ")
        print(cockpit(world, ROOT / "weights/beacon.pt", f["seed"]))
    report = {"forests": FORESTS, "densities": DENSITIES, "speeds": SPEEDS, "crossed": table}
    report |= {"first_seed": EVAL_FIRST, "worst_of": WORST_OF, "worst": worst}
    (ROOT / "results/atlas.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
