"""How soon does a training pass the paper's +180 %, and how soon does a taught one cross?

    .venv/bin/python -m extras.experiments.clock    # leave the machine alone: half an hour

Trains seeds in turn, and takes the time from the command to the line of each of the first test
points, imports and tests included. The test forests choose what best.pt keeps, so they cannot say
how good it is. The weights of each test point then fly through 200 forests that no training, test
or evaluation uses. The first to pass the bar there counts. Writes results/clock.json. A question
that has its answer there is not asked again.
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
from typing import NamedTuple

import numpy as np

from deepflight import dqn_pilot, summarize
from dqn import load_weights
from env import World, fly, fly_random

ROOT = Path(__file__).parents[2]
RESULT = ROOT / "results/clock.json"
FORESTS = range(5 * 10**9, 5 * 10**9 + 200)


class Question(NamedTuple):
    """When does a training pass a bar?"""

    flags: list[str]
    figure: str
    bar: float
    every: int  # steps between test points
    points: int  # how many of them to train to
    seeds: int  # seeds 0, 1, ...


QUESTIONS = {
    "from rewards": Question([], "over_random", 1.8, 5_000, 3, 5),
    "taught": Question(["--teacher"], "crossed", 0.5, 5_000, 10, 3),
}


def train(asked: Question, seed: int, folder: Path) -> list[float]:
    """Train to the last of the test points: the seconds of each. Keeps 0.pt, 1.pt, ..."""
    words = ["train", "--name", "clock", "--seed", str(seed), "--test-every", str(asked.every)]
    line, seconds = [sys.executable, str(ROOT / "deepflight.py"), *words, *asked.flags], []
    start = time.perf_counter()
    with subprocess.Popen(line, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        while len(seconds) < asked.points:
            next(row for row in process.stdout if "%" in row)  # one row a test point
            seconds.append(time.perf_counter() - start)
            shutil.copy(folder / "runs/clock/best.pt", folder / f"{len(seconds) - 1}.pt")
        process.send_signal(signal.SIGTERM)
        process.stdout.read()
    return seconds


def flown(path: Path, figure: str) -> float:
    """What these weights reach in forests that chose nothing."""
    rng, world = np.random.default_rng(0), World()
    q = load_weights(path, World.actions, beacon=False, camera="grey")
    bar = fly_random(FORESTS, world, rng)
    draws = rng.integers(len(FORESTS), size=(1, len(FORESTS)))
    return summarize(fly(dqn_pilot(q), FORESTS, world), bar, draws)[figure]["value"]


def answer(asked: Question, seed: int) -> dict[str, float]:
    """The step and the seconds of the first test point that passes; ValueError if none does."""
    with TemporaryDirectory() as folder:
        seconds = train(asked, seed, Path(folder))
        for point, passed in enumerate(seconds):
            if (found := flown(Path(folder) / f"{point}.pt", asked.figure)) > asked.bar:
                step = (point + 1) * asked.every
                print(f"seed {seed}: {found:.0%} at step {step:,}, {passed:.1f} s", flush=True)
                return {"step": step, "seconds": passed, asked.figure: found}
    raise ValueError(f"seed {seed} does not pass within {asked.points} test points")


def main() -> None:
    """Take every time, write them all."""
    report = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    for name, asked in QUESTIONS.items():
        if name in report:
            continue
        seeds = {str(seed): answer(asked, seed) for seed in range(asked.seeds)}
        report[name] = {"median": median(x["seconds"] for x in seeds.values()), "seeds": seeds}
        RESULT.write_text(json.dumps(report, indent=1) + "\n")
        print(f"{name}: median {report[name]['median']:.1f} s", flush=True)


if __name__ == "__main__":
    main()
