"""How much of a trained network still works? Counts its dead rectifiers.

    .venv/bin/python extras/dead.py

A rectifier that outputs zero passes no gradient back; one that always does is dead, as long as what
comes in does not change. The laser pilot flies the first ten evaluation forests; a filter counts as
dead if it outputs zero everywhere on all the frames met there, and so does a unit of the 512. A
network with a whole layer dead is blind: the last column says how many of nine actions it chooses
at all. The networks are those of the paper's settings, at their best and at the end of their 1.4
million steps, and the shipped one. Writes results/dead.json.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
import deepflight  # noqa: E402
from dqn import QNetwork  # noqa: E402
from env import World, refly  # noqa: E402

FILES = ("results/mnih/best.pt", "results/mnih/last.pt", "weights/paper.pt")
FORESTS = 10


def frames() -> Tensor:
    """The states (N, 4, 84, 84) uint8 of the laser's flights."""
    seeds = range(deepflight.EVAL_FIRST, deepflight.EVAL_FIRST + FORESTS)
    flights = deepflight.fly("laser", deepflight.laser_pilot, seeds, World())
    states = [s for f in flights for s, *_ in refly(f["seed"], f["actions"], World())]
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


def main() -> None:
    """Count, print, write."""
    torch.set_num_threads(2)
    s = frames()
    table = {file: count(deepflight.load_weights(ROOT / file, beacon=False), s) for file in FILES}
    for file, row in table.items():
        print(f"{file:22}", *(f"{name}: {x}" for name, x in row.items()), sep="   ")
    report = {"states": len(s), "first_seed": deepflight.EVAL_FIRST, "networks": table}
    (ROOT / "results/dead.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
