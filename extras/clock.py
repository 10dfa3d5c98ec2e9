"""How soon does a training pass the paper's +180 %? Wall-clock, alone on the machine.

    .venv/bin/python extras/clock.py        # leave the machine alone: ten minutes or less

Trains seeds 0 to 4 in turn, each from its command to the line of the first test point whose flights
are 180 % longer than random's, imports and the random pilot's flights included. The paper's
settings take too long for that: they train 20,000 steps, learning from step 5,000 on instead of
50,000, and their paces before and after that are taken for the whole way to the step at which the
log in results/mnih first passes. Writes results/clock.json.
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
from typing import Any

ROOT = Path(__file__).parent.parent
SEEDS, PAPER = range(5), 1.8
SLOW = ["--preset", "mnih", "--warmup", "5000", "--test-every", "5000"]


def passed(log: Path) -> int:
    """The step of the first test point above the paper's figure, 0 if there is none yet."""
    rows = csv.DictReader(log.open())
    return next((int(r["step"]) for r in rows if float(r["test_over_random"]) > PAPER), 0)


def run(flags: list[str], points: int) -> dict[str, Any]:
    """Train until the figure is passed, or for so many test points: the step, the seconds in all,
    and those of training up to each test point."""
    train = [sys.executable, str(ROOT / "deepflight.py"), "train", "--name", "clock", *flags]
    with TemporaryDirectory() as folder:
        start, out = time.perf_counter(), Path(folder) / "runs/clock"
        with subprocess.Popen(train, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
            for count, _ in enumerate((line for line in process.stdout if "%" in line), 1):
                if (step := passed(out / "log.csv")) or count == points:
                    break
            seconds = time.perf_counter() - start
            process.send_signal(signal.SIGTERM)
            process.stdout.read()
        timing = [float(row["seconds"]) for row in csv.DictReader((out / "timing.csv").open())]
    print(f"{' '.join(flags):40} {seconds:6.1f} s, +180 % at step {step:,}", flush=True)
    return {"step": step, "seconds": seconds, "timing": timing}


def main() -> None:
    """Take every time, write them all."""
    ours = {seed: run(["--seed", str(seed)], 60) for seed in SEEDS}
    slow, step = run(SLOW, 4), passed(ROOT / "results/mnih/log.csv")
    first, *_, last = slow["timing"]
    flying, learning = first / 5_000, (last - first) / 15_000  # s a step
    whole = slow["seconds"] - last + 50_000 * flying + (step - 50_000) * learning
    report = {"median": median(x["seconds"] for x in ours.values()), "seeds": ours}
    report |= {"mnih, measured": slow, "mnih, to the figure": whole}
    report["share"] = report["median"] / whole
    (ROOT / "results/clock.json").write_text(json.dumps(report, indent=1) + "\n")
    print(f"median {report['median']:.1f} s, the paper's settings {whole:.0f} s")


if __name__ == "__main__":
    main()
