"""What is a compass worth? Asked of a planner that sees all trunks near it, and not where it is.

    .venv/bin/python -m extras.experiments.compass        # a quarter of an hour

The expert of extras/lessons/expert.py flies here without knowing its place: it takes the middle of
the forest for it. For its heading it takes

    straight on      0, whichever way it has come to face
    by compass       the true one
    along the rows   its angle to the rows of trunks, whichever way along them is nearer

A camera may see the rows of trunks, and cannot see which way along them leads to the far edge. So
the last line says how far four frames can carry a pilot. Writes results/compass.json: the share of
500 episodes that cross, in %.
"""

import json
from pathlib import Path

import numpy as np

from deepflight import Config, measure
from env import Pilot, VecForest, World, fly
from extras.lessons.expert import plan, scan

RESULT = Path(__file__).parents[2] / "results/compass.json"
WORLD = World()
SETTINGS = Config(forward_reward=0.0, far_bonus=0.0)
FORESTS = range(2 * 10**9, 2 * 10**9 + 500)  # no training or validation plants these
FOLDS = {"straight on": 0, "by compass": 1, "along the rows": 2}


def planner(fold: int) -> Pilot:
    """A pilot by the laser. Of its heading it knows what stays the same where that turns by a part
    of a circle: all of it with fold 1, its angle to the rows with fold 2, nothing with fold 0."""

    def pilot(_s: np.ndarray, envs: VecForest) -> list[int]:
        actions = []
        for drone in envs.active:
            heading = np.angle(np.exp(1j * fold * drone.pose[2])) / max(fold, 1)  # rad
            pose = (WORLD.length / 2, 0.0, heading)
            actions.append(int(plan(*scan(drone), pose, WORLD, SETTINGS).argmax()))
        return actions

    return pilot


def main() -> None:
    """Fly the three, write and print."""
    report = {}
    for name, fold in FOLDS.items():
        crossed = measure(fly(planner(fold), FORESTS, WORLD))["crossed"]
        report[f"the laser pilot, {name}: crossed, %"] = float(100 * crossed.mean())
    RESULT.write_text(json.dumps(report, indent=1) + "\n")
    print("\n".join(f"{name}: {value:.1f}" for name, value in report.items()))


if __name__ == "__main__":
    main()
