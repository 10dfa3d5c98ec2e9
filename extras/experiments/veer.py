"""Does the drone stay inside the forest and veer to the middle, as the paper says [DF §III]?

    .venv/bin/python -m extras.experiments.veer

"The UAV tends to stay inside the obstacle forest, veering towards the middle of the environment if
one of the sides of the image is free from clutter." Clutter on a side is the share of its 42
columns with a trunk at the horizon. We fly weights/paper.pt and the random pilot through the first
100 evaluation forests and measure, with 95 % intervals by bootstrap over flights,

    towards clutter  the mean yaw rate, rad/s, positive towards the more cluttered side
    one side free    the same where one side has no trunk and the other has some
    towards middle   the mean yaw rate within 5 m of a side edge, positive away from that edge
    edge time        the share of all steps flown within 5 m of a side edge

Writes results/veer.json. Takes about two minutes.
"""

import json
from pathlib import Path

import numpy as np
import torch

import deepflight
from dqn import load_weights
from env import World, fly, random_pilot, refly
from render import PIXELS, backdrop

ROOT = Path(__file__).parents[2]
FORESTS, NEAR = 100, 5.0  # m from a side edge
WORLD = World()


def clutter(frame: np.ndarray) -> tuple[float, float]:
    """The left and the right half's share of columns with a trunk; frame (84, 84)."""
    row = PIXELS // 2  # just below the horizon
    trunk = frame[row] < backdrop(WORLD)[row]  # (84,)
    return float(trunk[:row].mean()), float(trunk[row:].mean())


def look(flight: dict) -> np.ndarray:
    """Fly again: left and right clutter, y in m, yaw rate in rad/s at every action (T, 4)."""
    steps = list(refly(flight["seed"], flight["actions"], WORLD))[:-1]
    rates = WORLD.yaw_rate * np.linspace(-1, 1, WORLD.actions)  # (A,) rad/s
    return np.array(
        [
            (*clutter(observation[-1]), info["pose"][1], rates[int(a)])
            for (observation, *_, info), a in zip(steps, flight["actions"], strict=True)
        ]
    )


def measures(x: np.ndarray) -> dict[str, np.ndarray]:
    """The values of each measure at the steps of one flight where it applies."""
    left, right, y, yaw = x.T
    towards, free = yaw * np.sign(left - right), (left == 0) != (right == 0)
    edge = np.abs(y) > WORLD.width / 2 - NEAR
    return {
        "towards clutter": towards[left != right],
        "one side free": towards[free],
        "towards middle": (-np.sign(y) * yaw)[edge],
        "edge time": edge,
    }


def figures(flights: list[dict]) -> dict[str, dict[str, float] | None]:
    """Each measure over all steps of all flights, flights resampled for the interval.

    None where no flight ever came to where it could be measured.
    """
    table, parts = {}, [measures(look(flight)) for flight in flights]
    draws = np.random.default_rng(0).integers(len(parts), size=(2000, len(parts)))
    for name in parts[0]:
        sums = np.array([part[name].sum() for part in parts])  # (F,)
        counts = np.array([len(part[name]) for part in parts])  # (F,)
        resampled = sums[draws].sum(1) / np.maximum(counts[draws].sum(1), 1)
        mean = sums.sum() / max(counts.sum(), 1)
        table[name] = deepflight.interval(mean, resampled) if counts.any() else None
    return table


def show(x: dict[str, float] | None) -> str:
    """A figure and its interval."""
    return "{value:.3f} [{low:.3f}, {high:.3f}]".format(**x) if x else "never there"


def main() -> None:
    """Fly both pilots, print the table, write it."""
    torch.set_num_threads(2)
    q = load_weights(ROOT / "weights/paper.pt", WORLD.actions, beacon=False, camera="grey")
    pilots = {
        "random": random_pilot(np.random.default_rng(0)),
        "dqn": deepflight.dqn_pilot(q),
    }
    seeds = range(deepflight.EVAL_FIRST, deepflight.EVAL_FIRST + FORESTS)
    table = {name: figures(fly(p, seeds, WORLD)) for name, p in pilots.items()}
    print(f"{'':18}" + "".join(f"{name:>28}" for name in table))
    for measure in table["dqn"]:
        cells = (show(table[name][measure]) for name in table)
        print(f"{measure:18}" + "".join(f"{cell:>28}" for cell in cells))
    report = {"forests": FORESTS, "first_seed": seeds[0], "pilots": table}
    (ROOT / "results/veer.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
