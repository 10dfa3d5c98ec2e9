"""Break it and watch: what each piece of the recipe is worth.

    .venv/bin/python extras/ablate.py             # all of them, two trainings at a time: an hour
    .venv/bin/python extras/ablate.py no_mirror   # one of them

Every diff in extras/ablations/ takes one piece out of the four files; by hand, `git apply` does it
and `git apply -R` takes it back. This script applies it to a scratch copy in runs/ablations/, and
there trains seeds 0 and 1, on one thread each, as far as step 50,000, by the recipe from before a
metre ahead had its reward. What it compares them with are the first 50,000 steps of that recipe's
own logs, in results/before, and 25,000 of three seeds more; all from one machine: on another, train
it there too. Writes results/ablations/, a log a training, and prints the README's table.
"""

import csv
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from statistics import mean

ROOT = Path(__file__).parent.parent
DIFFS = {path.stem: path for path in sorted((ROOT / "extras/ablations").glob("*.diff"))}
FILES = ("render.py", "env.py", "dqn.py", "deepflight.py")
BEFORE = ROOT / "results/before"
LOGS = {0: BEFORE / "paper/log.csv", 1: BEFORE / "paper-1/log.csv"}  # of the recipe
STEPS = 50_000
WINDOWS = ((10_000, 25_000), (30_000, STEPS))  # a figure is the mean of the test points therein
COLUMNS = ("test_over_random", "test_crash")


def copy(name: str, folder: Path) -> Path:
    """The four files in a fresh folder, one piece taken out."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for file in FILES:
        shutil.copy(ROOT / file, folder)
    apply = ["git", "apply", "--unsafe-paths", f"--directory={folder}", str(DIFFS[name])]
    subprocess.run(apply, cwd="/", check=True)
    return folder


def train(name: str, seed: int) -> None:
    """Train one seed without that piece, and keep its log."""
    folder = copy(name, ROOT / f"runs/ablations/{name}-{seed}")
    command = [sys.executable, "deepflight.py", "train", "--ahead", "0", "--far-value", "50"]
    command += ["--threads", "1", "--seed", str(seed)]
    log = folder / "runs/001/log.csv"
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        for line in process.stdout:
            print(f"{name} {seed}: {line}", end="", flush=True)
            if log.exists() and int(read(log)[-1]["step"]) >= STEPS:
                process.terminate()
    if int(read(log)[-1]["step"]) < STEPS:
        raise SystemExit(f"{name}, seed {seed}, stopped before step {STEPS:,}: its log is not kept")
    shutil.copy(log, ROOT / f"results/ablations/{name}-{seed}.csv")


def read(log: Path) -> list[dict[str, str]]:
    """The rows of a log, as far as step 50,000."""
    with log.open() as file:
        return [row for row in csv.DictReader(file) if int(row["step"]) <= STEPS]


def figures(log: Path) -> list[float]:
    """Of one training, in %: every column's mean over the early, then over the late test points."""
    windows = [[x for x in read(log) if a <= int(x["step"]) <= b] for a, b in WINDOWS]
    return [100 * mean(float(x[key]) for x in rows) for rows in windows if rows for key in COLUMNS]


def table() -> list[str]:
    """The README's rows: both seeds of the recipe, and without each piece that has been tried."""
    more = [BEFORE / f"seeds/{seed}.csv" for seed in (2, 3, 4)]  # as far as step 25,000
    logs = {"(the recipe)": list(LOGS.values()), "(the recipe, seeds 2 to 4)": more}
    for name in DIFFS:
        logs[name] = [ROOT / f"results/ablations/{name}-{seed}.csv" for seed in LOGS]
    rows = []
    for name, files in logs.items():
        if all(file.exists() for file in files):
            seeds = [figures(file) for file in files]
            cells = (", ".join(f"{x:.0f}" for x in column) for column in zip(*seeds, strict=True))
            rows.append(f"| {name} | {' | '.join(cells)} |")
    return rows


def main() -> None:
    """Train what is asked for, and print all there is."""
    names = sys.argv[1:] or DIFFS
    if unknown := set(names) - set(DIFFS):
        raise SystemExit(f"no ablation {', '.join(unknown)}, but: {', '.join(DIFFS)}")
    (ROOT / "results/ablations").mkdir(exist_ok=True)
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda job: train(*job), product(names, LOGS)))
    print("\n".join(table()))


if __name__ == "__main__":
    main()
