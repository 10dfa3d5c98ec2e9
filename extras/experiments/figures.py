"""Draw the README's pictures from results/: the paper's Figures 2 to 4, and more; not the atlas.

    extras/.venv/bin/pip install -r extras/requirements.txt
    extras/.venv/bin/python -m extras.experiments.figures

figures/learning.png: every results/*/log.csv is a training, and each is a curve.
figures/crossed.png: what crosses in the paper's world, beside the laser pilot with and without a
compass. figures/flight.gif: a flight of results/eval.json, flown again, with the values that
weights/paper.pt gives to each turn.
"""

import csv
import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from deepflight import film
from dqn import load_weights
from env import World, measure
from render import save_film

ROOT = Path(__file__).parents[2]
PAPER = 1.8  # the paper's figure: 180 % more flight time than random [DF, abstract]
PANELS = {  # column of log.csv -> title
    "train_return": "Figure 2: total reward in training,\nmean of 100 flights",
    "test_return": "Figure 3: total reward on the test forests",
    "test_steps": "Figure 4: flight time on the test forests, steps",
}
# folder -> label, and the colour that the recipe has in every picture
LABELS = {"paper": ("the paper's world", "C0"), "beacon": ("with the beacon", "C1")}
Log = dict[str, np.ndarray]  # the columns of a log.csv (T,)


def read(path: Path) -> Log:
    """The columns of a CSV file of numbers (T,)."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}


def levels(axes: plt.Axes, column: str, log: Log) -> None:
    """The random pilot, and the paper's 180 % above it."""
    if column == "test_steps":
        bar = log["test_steps"][-1] / (1 + log["test_over_random"][-1])  # steps
        axes.axhline((1 + PAPER) * bar, color="black", linestyle="--", label="the paper: +180 %")
    else:
        flown = json.loads((ROOT / "results/pilots.json").read_text())["pilots"]
        bar = flown["random"]["return"]["value"]
    axes.axhline(bar, color="black", linestyle=":", label="random pilot")


def finish(figure: Figure, name: str) -> None:
    """Write one picture."""
    for axes in figure.axes:
        axes.grid(alpha=0.3)
    figure.savefig(ROOT / "figures" / name, dpi=100)
    plt.close(figure)
    print(f"wrote figures/{name}")


def draw_learning() -> None:
    """Three panels, one picture."""
    paths = sorted(ROOT.glob("results/*/log.csv"), reverse=True)  # the paper's world first
    logs = {path.parent.name: read(path) for path in paths}
    figure, panels = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for axes, (column, title) in zip(panels, PANELS.items(), strict=True):
        for name, log in logs.items():
            label, colour = LABELS[name]
            axes.plot(log["step"], log[column], colour, label=label, linewidth=1.2)
        levels(axes, column, next(iter(logs.values())))
        axes.set_title(title, fontsize=11)
        axes.set(xlabel="control steps", xscale="log")
    handles, labels = panels[-1].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=9, ncols=len(labels), loc="outside lower center")
    finish(figure, "learning.png")


def draw_crossed() -> None:
    """The share of test flights that cross, a mean over five test points."""
    figure, axes = plt.subplots(figsize=(8, 4), layout="constrained")
    log = read(ROOT / "results/paper/log.csv")
    share = np.convolve(100 * log["test_crossed"], np.ones(5) / 5, "valid")  # (T - 4,) %
    colour = LABELS["paper"][1]
    axes.plot(log["step"][4:], share, colour, label="the camera pilot in training", linewidth=1.2)
    laser = json.loads((ROOT / "results/compass.json").read_text())
    for way, line in (("straight on", ":"), ("by compass", "--")):
        y = laser[f"the laser pilot, {way}: crossed, %"]
        axes.axhline(y, color="black", linestyle=line, label=f"the laser pilot, {way}")
    axes.set(title="Crossed in the paper's world, %", xlabel="control steps", ylim=(0, 100))
    figure.legend(fontsize=9, ncols=3, loc="outside lower center")
    finish(figure, "crossed.png")


def main() -> None:
    """The curves, then the film."""
    draw_learning()
    draw_crossed()
    report = json.loads((ROOT / "results/eval.json").read_text())
    flights = {name: pilot["flights"] for name, pilot in report["pilots"].items()}
    q = load_weights(ROOT / "weights/paper.pt", World.actions, beacon=False)
    first = int(measure(flights["dqn"])["crossed"].argmax())  # to cross
    pictures = film({name: flown[first] for name, flown in flights.items()}, World(), q)
    save_film(ROOT / "figures/flight.gif", pictures, round(1000 * World.dt))
    print("wrote figures/flight.gif")


if __name__ == "__main__":
    main()
