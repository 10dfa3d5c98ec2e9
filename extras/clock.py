"""How soon does a training pass the paper's +180 %? Wall-clock, alone on the machine.

    .venv/bin/python extras/clock.py        # leave the machine alone: ten minutes or less

Trains seeds 0 to 4 in turn, each from its command to the line of the first test point whose flights
are 180 % longer than random's, imports and the random pilot's flights included. The paper's
settings take too long for that: they train 20,000 steps, learning from step 5,000 on instead of
50,000, and that pace is taken for the one of all the learning before the step at which the log in
results/mnih first passes. With a fuller replay they are slower, so this flatters them. Writes
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

ROOT = Path(__file__).parent.parent
SEEDS, PAPER = range(5), 1.8
SLOW = ["--preset", "mnih", "--warmup", "5000"]


def passed(log: Path) -> int:
    """The step of the first test point above the paper's figure, 0 if there is none yet."""
    rows = csv.DictReader(log.open())
    return next((int(r["step"]) for r in rows if float(r["test_over_random"]) > PAPER), 0)


def run(flags: list[str], patience: int) -> dict[str, float]:
    """Train until the figure is passed, or for so many test points; the step, and seconds in all
    and without imports and the random pilot."""
    train = [sys.executable, str(ROOT / "deepflight.py"), "train", "--name", "clock", *flags]
    with TemporaryDirectory() as folder:
        start, out = time.perf_counter(), Path(folder) / "runs/clock"
        with subprocess.Popen(train, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
            lines = (line for line in process.stdout if "%" in line)
            for _ in range(patience):
                next(lines)
                if step := passed(out / "log.csv"):
                    break
            seconds = time.perf_counter() - start
            *_, last = csv.DictReader((out / "timing.csv").open())
            process.send_signal(signal.SIGTERM)
            process.stdout.read()
        print(f"{' '.join(flags):32} {seconds:6.1f} s, +180 % at step {step:,}", flush=True)
    return {"step": step, "seconds": seconds, "trained": float(last["seconds"])}


def main() -> None:
    """Take every time, write them all."""
    ours = {seed: run(["--seed", str(seed)], 100) for seed in SEEDS}
    slow, step = run(SLOW, 1), passed(ROOT / "results/mnih/log.csv")
    stretches = (step - 50_000) / (20_000 - 5_000)  # of learning, each as long as the measured one
    whole = slow["seconds"] + (stretches - 1) * slow["trained"]
    report = {"median": median(x["seconds"] for x in ours.values()), "seeds": ours}
    report |= {"mnih, measured": slow, "mnih, to the figure": whole}
    report["share"] = report["median"] / whole
    (ROOT / "results/clock.json").write_text(json.dumps(report, indent=1) + "\n")
    print(json.dumps({k: x for k, x in report.items() if k != "seeds"}, indent=1))


if __name__ == "__main__":
    main()
