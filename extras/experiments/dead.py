"""How much of a trained network still works? Counts its dead rectifiers.

    .venv/bin/python -m extras.experiments.dead                    # both shipped networks
    .venv/bin/python -m extras.experiments.dead runs/001/best.pt   # any others

A rectifier that outputs zero passes no gradient back; one that always does is dead, as long as what
comes in does not change. The laser pilot flies the first ten evaluation forests; a filter counts as
dead if it outputs zero everywhere on all the frames met there, and so does a unit of the 512. A
network with a whole layer dead is blind: the last column says how many of nine actions it chooses
at all. A weights file says whether its network was trained with the beacon, and the forests have a
beacon accordingly. Writes results/dead.json.
"""

import argparse
import json
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from deepflight import EVAL_FIRST
from dqn import DQNConfig, QNetwork, load, load_weights
from env import World, fly, laser_pilot, refly

ROOT = Path(__file__).parents[2]
SHIPPED = tuple(f"weights/{x}.pt" for x in ("paper", "beacon", "scratch", "beacon-scratch"))
FORESTS = 10


@cache
def frames(beacon: bool, forests: int) -> Tensor:
    """The states (N, 4, 84, 84) uint8 of the laser's flights."""
    world, seeds = World(beacon=beacon), range(EVAL_FIRST, EVAL_FIRST + forests)
    flights = fly(laser_pilot(DQNConfig.gamma), seeds, world, blind=True)
    states = [s for f in flights for s, *_ in refly(f["seed"], f["actions"], world)]
    return torch.from_numpy(np.stack(states))


@torch.no_grad()
def count(q: QNetwork, s: Tensor) -> dict[str, str]:
    """Dead rectifiers "of all", layer by layer, and the actions chosen; s (N, 4, 84, 84)."""
    x, row = s.float() / 255, {}
    for layer in (*q.conv, *q.head):
        x = layer(x)
        if isinstance(layer, nn.ReLU):
            alive = x.transpose(0, 1).flatten(1).amax(1) > 0  # (filters,)
            row[f"layer {len(row) + 1}"] = f"{int((~alive).sum())} of {len(alive)}"
    return row | {"actions": f"{len(x.argmax(1).unique())} of {x.shape[1]}"}


def examine(path: Path, forests: int = FORESTS) -> dict[str, bool | str]:
    """A weights file: its beacon flag, and the count in the world of that flag."""
    beacon = load(path, "weights")["beacon"]
    q = load_weights(path, World.actions, beacon=beacon, camera="grey")
    return {"beacon": beacon} | count(q, frames(beacon, forests))


def main() -> None:
    """Count, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", default=SHIPPED, help="weights; default: the shipped")
    files = parser.parse_args().files
    torch.set_num_threads(2)
    table = {file: examine(ROOT / file) for file in files}
    for file, row in table.items():
        print(f"{file:22}", *(f"{name}: {x}" for name, x in row.items()), sep="   ")
    report = {"forests": FORESTS, "first_seed": EVAL_FIRST, "networks": table}
    (ROOT / "results/dead.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
