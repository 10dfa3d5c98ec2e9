"""Does the drone stay inside the forest and veer to the middle, as the paper says [DF §III]?

    .venv/bin/python -m extras.experiments.veer

"The UAV tends to stay inside the obstacle forest, veering towards the middle of the environment if
one of the sides of the image is free from clutter." Clutter on a side is the share of its 42
columns with a trunk at the horizon. We fly the random pilot, weights/dqn.pt and
weights/imitation.pt through the first 100 test forests and measure, with 95 % intervals by
bootstrap over episodes,

    towards clutter  the mean yaw rate, rad/s, positive towards the more cluttered side
    one side free    the same where one side has no trunk and the other has some
    towards middle   the mean yaw rate within 5 m of a side edge, positive away from that edge
    edge time        the share of all steps flown within 5 m of a side edge

Writes results/veer.json. Takes about three minutes.
"""

import json
from pathlib import Path

import numpy as np
import torch

from deepflight import dqn_pilot, interval, load_weights
from env import Episode, World, fly, random_pilot, refly
from render import PIXELS, background

ROOT = Path(__file__).parents[2]
FIRST, FORESTS, NEAR = 2 * 10**9, 100, 5.0  # NEAR: m from a side edge
WORLD = World()


def clutter(frame: np.ndarray) -> tuple[float, float]:
    """The left and the right half's share of columns with a trunk; frame (84, 84)."""
    row = PIXELS // 2  # just below the horizon
    trunk = frame[row] < background(WORLD)[row]  # (84,)
    return float(trunk[:row].mean()), float(trunk[row:].mean())


def look(episode: Episode) -> np.ndarray:
    """Fly again: left and right clutter, y in m, yaw rate in rad/s at every action (T, 4)."""
    rates = WORLD.yaw_rate * np.linspace(-1, 1, WORLD.num_actions)  # (A,) rad/s
    flown = zip(refly(episode, WORLD), episode["actions"], strict=False)  # without the last frame
    return np.array([(*clutter(s[-1]), drone.pose[1], rates[int(a)]) for (s, drone), a in flown])


def measures(x: np.ndarray) -> dict[str, np.ndarray]:
    """The values of each measure at the steps of one episode where it applies."""
    left, right, y, yaw = x.T
    towards, free = yaw * np.sign(left - right), (left == 0) != (right == 0)
    edge = np.abs(y) > WORLD.width / 2 - NEAR
    return {
        "towards clutter": towards[left != right],
        "one side free": towards[free],
        "towards middle": (-np.sign(y) * yaw)[edge],
        "edge time": edge,
    }


def metrics(episodes: list[Episode]) -> dict[str, dict[str, float] | None]:
    """Each measure over all steps of all episodes, episodes resampled for the interval.

    None where no episode ever came to where it could be measured.
    """
    table, parts = {}, [measures(look(episode)) for episode in episodes]
    draws = np.random.default_rng(0).integers(len(parts), size=(2000, len(parts)))
    for name in parts[0]:
        sums = np.array([part[name].sum() for part in parts])  # (F,)
        counts = np.array([len(part[name]) for part in parts])  # (F,)
        resampled = sums[draws].sum(1) / np.maximum(counts[draws].sum(1), 1)
        mean = sums.sum() / max(counts.sum(), 1)
        table[name] = interval(mean, resampled) if counts.any() else None
    return table


def show(x: dict[str, float] | None) -> str:
    """A metric and its interval."""
    return "{value:.3f} [{low:.3f}, {high:.3f}]".format(**x) if x else "never there"


def main() -> None:
    """Fly all pilots, print the table, write it."""
    torch.set_num_threads(2)
    pilots = {"random": random_pilot(np.random.default_rng(0))}
    for name in ("dqn", "imitation"):
        pilots[name] = dqn_pilot(load_weights(ROOT / f"weights/{name}.pt")[0])
    seeds = range(FIRST, FIRST + FORESTS)
    table = {name: metrics(fly(pilot, seeds, WORLD)) for name, pilot in pilots.items()}
    print(f"{'':18}" + "".join(f"{name:>28}" for name in table))
    for measure in table["dqn"]:
        cells = (show(table[name][measure]) for name in table)
        print(f"{measure:18}" + "".join(f"{cell:>28}" for cell in cells))
    report = {"forests": FORESTS, "first_seed": seeds[0], "pilots": table}
    (ROOT / "results/veer.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
