"""How soon does a training pass the paper's +180 %? Wall-clock, alone on the machine.

    .venv/bin/python -m extras.experiments.clock    # leave the machine alone: five minutes or less

Trains seeds 0 to 4 in turn, each from its command to the line of the first test point whose flights
are 180 % longer than random's, imports and the random pilot's flights included. Writes
results/clock.json.
"""

import csv
import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parents[2]
SEEDS, PAPER = range(5), 1.8


def passed(log: Path) -> int:
    """The step of the first test point above the paper's figure, 0 if there is none yet."""
    with log.open() as file:
        rows = list(csv.DictReader(file))
    return next((int(r["step"]) for r in rows if float(r["test_over_random"]) > PAPER), 0)


def run(flags: list[str]) -> dict[str, float]:
    """Train until the figure is passed: the step, 0 if never, and the seconds in all."""
    train = [sys.executable, str(ROOT / "deepflight.py"), "train", "--name", "clock", *flags]
    with TemporaryDirectory() as folder:
        step, start, log = 0, time.perf_counter(), Path(folder) / "runs/clock/log.csv"
        with subprocess.Popen(train, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
            points = (line for line in process.stdout if "%" in line)  # one line a test point
            while not step and next(points, None):
                step = passed(log)
            seconds = time.perf_counter() - start
            process.send_signal(signal.SIGTERM)
            process.stdout.read()
    print(f"{' '.join(flags):40} {seconds:6.1f} s, +180 % at step {step:,}", flush=True)
    return {"step": step, "seconds": seconds}


def main() -> None:
    """Take every time, write them all."""
    seeds = {seed: run(["--seed", str(seed)]) for seed in SEEDS}
    report = {"median": median(x["seconds"] for x in seeds.values()), "seeds": seeds}
    (ROOT / "results/clock.json").write_text(json.dumps(report, indent=1) + "\n")
    print(f"median {report['median']:.1f} s")


if __name__ == "__main__":
    main()
