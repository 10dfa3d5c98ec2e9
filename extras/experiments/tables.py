"""tables.py: print the tables of README.md and results/README.md from the files in results/.

    .venv/bin/python -m extras.experiments.tables

tests/test_readme.py compares what this prints with what stands in the two pages.
"""

import io
import json
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import deepflight

ROOT = Path(__file__).resolve().parents[2]
LABELS = {
    "goal": "arrived, %", "crossed": "crossed, %", "crash": "hit a trunk, %",
    "longer": "longer than random, %", "return": "return",
}  # fmt: skip
FRONT = {  # heading -> file, pilot
    "DQN, seed 0": ("dqn", "dqn"), "seed 1": ("dqn-1", "dqn"), "seed 2": ("dqn-2", "dqn"),
    "beacon, seed 0": ("dqn-beacon", "dqn"),
}  # fmt: skip
FULL = {
    "DQN": ("dqn", "dqn"), "DQN, beacon": ("dqn-beacon", "dqn"),
    "imitation": ("imitation", "imitation"),
    "imitation, beacon": ("imitation-beacon", "imitation"), "laser": ("imitation", "laser"),
}  # fmt: skip
LESSONS = {  # label -> file of seed 0, pilot, number of seeds
    "DQN": ("dqn", "dqn", 3), "imitation": ("imitation", "imitation", 2),
    "32 demonstrations alone": ("demonstrations-32", "demonstrations", 2),
    "imitation from disparity": ("imitation-disparity", "imitation", 2),
    "PQN": ("pqn", "pqn", 3), "memory": ("memory", "memory", 2), "DRQN": ("drqn", "drqn", 2),
    "DRQN that forgets": ("drqn-forget", "drqn", 2),
    "place": ("place", "place", 2), "DQN and beacon": ("dqn-beacon", "dqn", 2),
    "imitation and beacon": ("imitation-beacon", "imitation", 2),
    "place and beacon": ("place-beacon", "place", 2), "the planner": ("imitation", "laser", 1),
}  # fmt: skip


def read(name: str) -> dict[str, Any]:
    """A file that `eval --json` wrote."""
    return json.loads((ROOT / "results" / f"{name}.json").read_text())


def metric(pilot: dict[str, Any], key: str) -> str:
    """A metric with its interval, as in 69.1 [66.2, 71.9]."""
    factor, digits = (1, 1) if key == "return" else (100, 0 if key == "longer" else 1)
    value, low, high = (f"{factor * x:z.{digits}f}" for x in pilot[key].values())
    return f"{value} [{low}, {high}]"


def markdown(columns: dict[str, tuple[str, str]]) -> str:
    """A table in Markdown: one row a metric, one column a pilot."""
    pilots = [read(file)["pilots"][pilot] for file, pilot in columns.values()]
    lines = ["| | " + " | ".join(columns) + " |", "|" + "---|" * (len(columns) + 1)]
    for key, label in LABELS.items():
        lines.append(f"| {label} | " + " | ".join(metric(pilot, key) for pilot in pilots) + " |")
    return "\n".join(lines)


def minutes(name: str) -> str:
    """How long a training took by its log, if results/ keeps it."""
    log = ROOT / "results" / name / "log.csv"
    return f"{float(log.read_text().split(',')[-1]) / 60:.0f}" if log.exists() else ""


def lessons() -> str:
    """The table of extras/lessons/README.md: one row a pilot, one column a metric."""
    lines = ["| | " + " | ".join([*LABELS.values(), "minutes"]) + " |", "|---" * 7 + "|"]
    for label, (file, pilot, seeds) in LESSONS.items():
        for seed in range(seeds):
            name, trained = f"{file}-{seed}".removesuffix("-0"), pilot != "laser"
            cells = [metric(read(name)["pilots"][pilot], key) for key in LABELS]
            cells += [minutes(name) if trained else ""]
            lines.append(f"| {label}{f', seed {seed}' * trained} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def front() -> str:
    """What `eval` prints, from results/eval.json."""
    report, out = read("eval"), io.StringIO()
    with redirect_stdout(out):
        print(f"{report['forests']} forests from seed {report['first_seed']}; ", end="")
        print("95 % intervals in [ ]\n")
        deepflight.print_table(report["pilots"])
    return out.getvalue().rstrip()


def outcomes(file: str, pilot: str) -> str:
    """How the episodes of a pilot ended."""
    ended = [episode["outcome"] for episode in read(file)["pilots"][pilot]["episodes"]]
    return ", ".join(f"{ended.count(outcome)} {outcome}" for outcome in deepflight.OUTCOMES)


if __name__ == "__main__":
    print(front(), markdown(FRONT), markdown(FULL), lessons(), sep="\n\n")
    for name in FULL.values():
        print(*name, outcomes(*name))
