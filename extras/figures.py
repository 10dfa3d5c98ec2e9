"""Draw the README's pictures from results/: the paper's Figures 2 to 4, and more; not the atlas.

    extras/.venv/bin/pip install -r extras/requirements.txt
    extras/.venv/bin/python extras/figures.py

figures/learning.png: every folder of results/ with a log.csv is a training in the world its
config.json names; those of one world, recipe and length are one curve, their spread a band.
figures/crossed.png: what crossed in the paper's world, beside the laser pilot with and without a
compass. figures/flights.png and flight.gif: the flights of results/eval.json, flown again.
"""

import csv
import json
import sys
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
from deepflight import draw_pictures  # noqa: E402
from env import World  # noqa: E402

PAPER = 1.8  # the paper's figure: 180 % more flight time than random [DF, abstract]
CROSSED = {  # log in results/ -> label
    "paper/log.csv": "our recipe",
    "before/paper/log.csv": "the recipe before, seed 0",
    "before/paper-1/log.csv": "the recipe before, seed 1",
    "tried/far-and-dead.csv": "an update in 16 steps, ends worth +200 and -100",
}
PANELS = {  # column of log.csv -> title
    "train_return": "Figure 2: return in training, mean of 100 flights",
    "test_return": "Figure 3: return on the test forests",
    "test_steps": "Figure 4: flight time on the test forests, steps",
}


def read(path: Path) -> dict[str, np.ndarray]:
    """The columns of a CSV file of numbers (T,)."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}


def trainings() -> dict[str, list[dict[str, np.ndarray]]]:
    """The logs of every training in results/, by what it was."""
    groups = defaultdict(list)
    for folder in sorted(path.parent for path in (ROOT / "results").rglob("log.csv")):
        config = json.loads((folder / "config.json").read_text())
        ours = "our recipe" if "ahead" in config else "the recipe before"
        ours += f", {config['steps']:,} steps"
        recipe = "the paper's settings" if config["optimizer"] == "rmsprop" else ours
        log = read(folder / "log.csv")
        minutes = read(folder / "timing.csv")["seconds"] / 60  # (T,)
        groups[recipe + (", beacon" if config["beacon"] else "")].append(log | {"minutes": minutes})
    return dict(groups)


def curve(axes: plt.Axes, logs: list[dict], x: str, y: str, label: str) -> None:
    """The mean of several trainings over their common test points, and the band they span."""
    length = min(len(log[y]) for log in logs)
    values = np.array([log[y][:length] for log in logs])  # (seeds, T)
    at = np.mean([log[x][:length] for log in logs], 0)  # (T,)
    seeds = f", {len(logs)} seeds" if len(logs) > 1 else ", 1 seed"
    (line,) = axes.plot(at, values.mean(0), label=label + seeds, linewidth=1.2)
    axes.fill_between(at, values.min(0), values.max(0), color=line.get_color(), alpha=0.25)


def levels(axes: plt.Axes, y: str, logs: list[dict]) -> None:
    """The random pilot, and the paper's 180 % above it."""
    if y == "test_steps":
        bar = logs[0]["test_steps"][-1] / (1 + logs[0]["test_over_random"][-1])  # steps
        axes.axhline((1 + PAPER) * bar, color="black", linestyle="--", label="paper: +180 %")
    else:
        flown = json.loads((ROOT / "results/pilots.json").read_text())["pilots"]
        bar = flown["random"]["return"]["value"]
    axes.axhline(bar, color="black", linestyle=":", label="random pilot")


def draw_learning() -> None:
    """Four panels, one picture."""
    groups = trainings()
    figure, panels = plt.subplots(2, 2, figsize=(12, 8), layout="constrained")
    for axes, (y, title) in zip(panels.flat, PANELS.items(), strict=False):
        for label, logs in groups.items():
            curve(axes, logs, "step", y, label)
        levels(axes, y, next(iter(groups.values())))
        axes.set(title=title, xlabel="control steps", xscale="log")
    axes = panels[1, 1]
    for label, logs in groups.items():
        curve(axes, logs, "minutes", "test_steps", label)
    levels(axes, "test_steps", next(iter(groups.values())))
    axes.set(title="Flight time against the clock, steps", xlabel="minutes", xscale="log")
    for axes in panels.flat:
        axes.grid(alpha=0.3)
    panels[1, 0].legend(fontsize=8)
    figure.savefig(ROOT / "figures/learning.png", dpi=100)
    print("wrote figures/learning.png")


def draw_crossed() -> None:
    """The share of test flights that cross, a mean over five test points."""
    figure, axes = plt.subplots(figsize=(8, 4), layout="constrained")
    for name, label in CROSSED.items():
        log = read(ROOT / "results" / name)
        share = np.convolve(100 * log["test_crossed"], np.ones(5) / 5, "valid")  # (T - 4,) %
        axes.plot(log["step"][4:], share, label=label, linewidth=1.2)
    laser = json.loads((ROOT / "results/compass.json").read_text())
    for way, line in (("straight on", ":"), ("by compass", "--")):
        y = laser[f"the laser pilot, {way}: crossed, %"]
        axes.axhline(y, color="black", linestyle=line, label=f"laser pilot, {way}")
    axes.set(title="Crossed in the paper's world, %", xlabel="control steps", ylim=(0, 100))
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    figure.savefig(ROOT / "figures/crossed.png", dpi=100)
    print("wrote figures/crossed.png")


def main() -> None:
    """The curves, then the flights."""
    draw_learning()
    draw_crossed()
    report = json.loads((ROOT / "results/eval.json").read_text())
    seeds = range(report["first_seed"], report["first_seed"] + report["forests"])
    flights = {name: pilot["flights"] for name, pilot in report["pilots"].items()}
    draw_pictures(flights, seeds, World(beacon=report["beacon"]), ROOT / "figures")


if __name__ == "__main__":
    main()
