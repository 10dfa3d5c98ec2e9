"""exercises.py: does the answer hold? Makes the trainings of exercises.md, and its table.

    .venv/bin/python -m extras.lessons.exercises 4      measure the answer to exercise 4
    .venv/bin/python -m extras.lessons.exercises table  print the table of all that were measured

An answer is a diff, a command, or both. They stand in exercises.md, and this file takes them from
there: it copies the repository to runs/exercise-4, changes the copy by the diff, trains there with
the seeds 0 and 1, and flies both networks through 200 validation forests that chose no weights.
What it finds goes into results/exercises.json. An exercise without a command of its own flies the
networks of exercise 0, which is the recipe that all others are compared with.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
RESULT, TEXT = ROOT / "results/exercises.json", Path(__file__).with_name("exercises.md")
FLY = "eval --first-seed 1000000048 --episodes 200 --json flown.json --weights"
PARTS = "value", "low", "high"
COLUMNS = {"crossed": 100, "goal": 100, "crash": 100, "steps": 1, "return": 1}  # and their factors


def read(number: str) -> tuple[str, list[str]]:
    """The diff and the words of the command in the section of an exercise; either may be empty."""
    (section,) = re.findall(rf"^## {number}\. (.*?)(?=^## |\Z)", TEXT.read_text(), re.M | re.S)
    diffs = re.findall(r"^```diff\n(.*?)^```", section, re.M | re.S)
    command = re.search(r"^\.venv/bin/python deepflight\.py (train .*)$", section, re.M)
    return "".join(diffs), command[1].split() if command else []


def prepare(number: str, copy: Path) -> None:
    """Copy the repository there, and change the copy as the answer says."""
    shutil.rmtree(copy, ignore_errors=True)
    skip = shutil.ignore_patterns("runs", ".*", "results", "figures", "extras", "tests")
    shutil.copytree(ROOT, copy, ignore=skip)
    if diff := read(number)[0]:
        alone = os.environ | {"GIT_CEILING_DIRECTORIES": str(copy.parent)}  # not our repository
        subprocess.run(["git", "apply"], input=diff, text=True, cwd=copy, env=alone, check=True)


def measure(number: str) -> None:
    """Train and fly with both seeds."""
    copy, (_, train) = ROOT / f"runs/exercise-{number}", read(number)
    prepare(number, copy)
    run = [sys.executable, "deepflight.py"]
    for seed in "01":
        home = copy if train else ROOT / "runs/exercise-0"
        if train:
            subprocess.run([*run, *train, "--seed", seed, "--name", seed], cwd=copy, check=True)
        weights = home / f"runs/{seed}/best.pt"
        subprocess.run([*run, *FLY.split(), str(weights)], cwd=copy, check=True)
        flown = json.loads((copy / "flown.json").read_text())["pilots"]["dqn"]
        report = json.loads(RESULT.read_text()) if RESULT.exists() else {}
        report.setdefault(number, {})[seed] = {key: flown[key] for key in COLUMNS}
        RESULT.write_text(json.dumps(report, indent=1, sort_keys=True) + "\n")


def table() -> str:
    """A row an exercise: both seeds, with the interval over forests of each."""
    report = json.loads(RESULT.read_text())
    lines = ["| exercise | crossed, % | arrived, % | hit a trunk, % | steps | return |"]
    lines.append("|" + "---|" * 6)
    for number in sorted(report, key=int):
        row = []
        for key, factor in COLUMNS.items():
            seeds = [[factor * flown[key][x] for x in PARTS] for flown in report[number].values()]
            row.append("; ".join(f"{x:z.0f} [{low:z.0f}, {high:z.0f}]" for x, low, high in seeds))
        title = re.search(rf"^## {number}\. (.*)$", TEXT.read_text(), re.M)[1]
        lines.append(f"| {number} {title} | {' | '.join(row)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    for word in sys.argv[1:]:
        print(table()) if word == "table" else measure(word)
