"""Draw the README's pictures from results/: the paper's Figures 2 to 4, and more; not the atlas.

    extras/.venv/bin/pip install -r extras/requirements.txt
    extras/.venv/bin/python -m extras.experiments.figures

figures/learning.png: a curve is a training, from rewards or taught, against control steps and
against flights; Mnih's settings are rung 0 of the ladder.
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
CURVES = {  # label -> folders in results/, one a seed, and the colour in the picture
    "from rewards": ("scratch*", "C0"),
    "with the beacon": ("beacon-scratch", "C1"),
    "Mnih's settings": ("ladder/0-0", "C2"),
    "taught": ("paper", "C3"),
    "taught, with the beacon": ("beacon", "C4"),
}
AXES = {"step": "control steps", "episodes": "flights"}  # column of log.csv -> label
Log = dict[str, np.ndarray]  # the columns of a log.csv (T,)


def read(path: Path) -> Log:
    """The columns of a CSV file of numbers (T,)."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}


def logs(folders: str) -> list[Log]:
    """The logs of these folders of results/, seed 0 first."""
    return [read(path) for path in sorted(ROOT.glob(f"results/{folders}/log.csv"))]


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
    """Three panels against control steps, and three against flights."""
    figure, panels = plt.subplots(2, 3, figsize=(13, 7), sharey="col", layout="constrained")
    for row, (x, text) in zip(panels, AXES.items(), strict=True):
        for axes, (column, title) in zip(row, PANELS.items(), strict=True):
            for label, (folders, colour) in CURVES.items():
                for log in logs(folders):
                    axes.plot(log[x], log[column], colour, label=label, linewidth=1)
            levels(axes, column, log)
            axes.set(xlabel=text, xscale="log")
            if x == "step":
                axes.set_title(title, fontsize=11)
    handles, labels = axes.get_legend_handles_labels()
    legend = dict(zip(labels, handles, strict=True))  # each label once
    figure.legend(legend.values(), legend, fontsize=9, ncols=4, loc="outside lower center")
    finish(figure, "learning.png")


def draw_crossed() -> None:
    """The share of test flights that cross, a mean over five test points."""
    figure, axes = plt.subplots(figsize=(8, 4), layout="constrained")
    for seed, log in enumerate(logs("scratch*")):
        label = f"from rewards, seed {seed}"
        share = np.convolve(100 * log["test_crossed"], np.ones(5) / 5, "valid")  # (T - 4,) %
        axes.plot(log["step"][4:], share, f"C{seed}", label=label, linewidth=1.2)
    (log,) = logs("paper")
    axes.plot(log["step"], 100 * log["test_crossed"], "C3", label="taught", linewidth=1.2)
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
    q = load_weights(ROOT / "weights/paper.pt", World.actions, beacon=False, camera="grey")
    first = int(measure(flights["dqn"])["crossed"].argmax())  # to cross
    pictures = film({name: flown[first] for name, flown in flights.items()}, World(), q)
    save_film(ROOT / "figures/flight.gif", pictures, round(1000 * World.dt))
    print("wrote figures/flight.gif")


if __name__ == "__main__":
    main()
