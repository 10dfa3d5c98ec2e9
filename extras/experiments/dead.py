"""How much of a trained network still works? Counts its dead rectifiers.

    .venv/bin/python -m extras.experiments.dead                    # four shipped networks
    .venv/bin/python -m extras.experiments.dead runs/001/best.pt   # any others

A rectifier that outputs zero passes no gradient back; one that always does is dead, as long as what
comes in does not change. The laser pilot flies the first ten test forests; a filter counts as dead
if it outputs zero everywhere on all the frames met there, and so does a unit of the 512. A network
with a whole layer dead is blind: the last column says how many of nine actions it chooses at all.
Each network looks at the world that its weights file names. Writes results/dead.json.
"""

import argparse
import json
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from deepflight import Config, load_weights
from dqn import QNetwork
from env import World, fly, refly
from extras.lessons.expert import laser_pilot

ROOT = Path(__file__).parents[2]
SHIPPED = tuple(f"weights/{x}.pt" for x in ("dqn", "dqn-beacon", "imitation", "imitation-beacon"))
FIRST, FORESTS = 2 * 10**9, 10  # no training or validation plants these


@cache
def observations(world: World, forests: int) -> Tensor:
    """What the laser pilot would see on its way (N, 4, 84, 84) uint8."""
    seeds = range(FIRST, FIRST + forests)
    episodes = fly(laser_pilot(Config.gamma), seeds, world, blind=True)
    return torch.from_numpy(np.stack([s for e in episodes for s, _ in refly(e, world)]))


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


def main() -> None:
    """Count, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", default=SHIPPED, help="weights; default: the shipped")
    files = parser.parse_args().files
    torch.set_num_threads(2)
    table = {}
    for file in files:
        q, world, _ = load_weights(ROOT / file)
        table[file] = {"beacon": world.beacon} | count(q, observations(world, FORESTS))
        print(f"{file:27}", *(f"{name}: {x}" for name, x in table[file].items()), sep="   ")
    report = {"forests": FORESTS, "first_seed": FIRST, "networks": table}
    (ROOT / "results/dead.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
