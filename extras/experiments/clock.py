"""How soon does a training pass the paper's +180 %? Wall-clock, alone on the machine.

    .venv/bin/python -m extras.experiments.clock    # leave the machine alone: ten minutes

Trains seeds 0 to 4 in turn, and takes the time from the command to the line of each of the first
test points, imports included. The test forests choose what best.pt keeps, so they cannot say how
good it is. The weights of each test point then fly through 200 forests that no training, test or
evaluation uses. The first whose flights are 180 % longer there than random's counts. Writes
results/clock.json.
"""

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np

from deepflight import RunConfig, dqn_pilot
from dqn import load_weights
from env import World, fly, fly_random, measure

ROOT = Path(__file__).parents[2]
SEEDS, PAPER, POINTS = range(5), 1.8, 3
FORESTS = range(5 * 10**9, 5 * 10**9 + 200)


def train(seed: int, folder: Path) -> list[float]:
    """Train to the last of the test points: the seconds of each. Keeps 0.pt, 1.pt, ..."""
    words = ["train", "--name", "clock", "--seed", str(seed)]
    line, seconds, start = [sys.executable, str(ROOT / "deepflight.py")], [], time.perf_counter()
    with subprocess.Popen(line + words, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        while len(seconds) < POINTS:
            next(row for row in process.stdout if "%" in row)  # one row a test point
            seconds.append(time.perf_counter() - start)
            shutil.copy(folder / "runs/clock/best.pt", folder / f"{len(seconds) - 1}.pt")
        process.send_signal(signal.SIGTERM)
        process.stdout.read()
    return seconds


def longer(path: Path, bar: float) -> float:
    """How much longer than random these weights fly, as a share."""
    q = load_weights(path, World.actions, beacon=False)
    return measure(fly(dqn_pilot(q), FORESTS, World()))["steps"].mean().item() / bar - 1


def run(seed: int, bar: float) -> dict[str, float]:
    """The step and the seconds of the first test point that passes; ValueError if none does."""
    with TemporaryDirectory() as folder:
        seconds = train(seed, Path(folder))
        for point, passed in enumerate(seconds):
            if (over := longer(Path(folder) / f"{point}.pt", bar)) > PAPER:
                step = (point + 1) * RunConfig.test_every
                print(f"seed {seed}: {over:+.0%} at step {step:,} after {passed:.1f} s", flush=True)
                return {"step": step, "seconds": passed, "over_random": over}
    raise ValueError(f"seed {seed} is not past +180 % at test point {POINTS}")


def main() -> None:
    """Take every time, write them all."""
    bar = measure(fly_random(FORESTS, World(), np.random.default_rng(0)))["steps"].mean().item()
    seeds = {seed: run(seed, bar) for seed in SEEDS}
    report = {"median": median(x["seconds"] for x in seeds.values()), "seeds": seeds}
    (ROOT / "results/clock.json").write_text(json.dumps(report, indent=1) + "\n")
    print(f"median {report['median']:.1f} s")


if __name__ == "__main__":
    main()
