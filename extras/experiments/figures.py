"""Draw the README's pictures from results/: the paper's Figures 2 to 4, and more.

    extras/.venv/bin/pip install -r extras/requirements.txt
    extras/.venv/bin/python -m extras.experiments.figures

figures/learning.png: a curve is a training, against control steps and against episodes.
figures/crossed.png: what crosses in the paper's world, beside the laser pilot with and without a
compass.
figures/transfer.png: the looks of extras/lessons/looks.py, each with the % that cross, by the
shipped pilot and by the one that was trained with random looks.
figures/flight.gif: the first episode of results/eval.json that crosses, flown again, with the
values that weights/dqn.pt gives to each turn.
"""

import json
from collections.abc import Iterable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from deepflight import draw_film, load_weights, measure
from env import World, plant
from extras.lessons import looks
from render import save_film

ROOT = Path(__file__).parents[2]
PAPER = 1.8  # the paper's figure: 180 % more flight time than random [DF, abstract]
PANELS = {  # column of log.csv -> title
    "train_return": "Figure 2: total reward in training,\nmean of 100 episodes",
    "validation_return": "Figure 3: total reward in validation",
    "validation_steps": "Figure 4: steps of an episode in validation",
}
CURVES = {  # label -> folders in results/, one a seed, and the colour
    "from rewards": (("dqn", "dqn-1", "dqn-2"), "C0"),
    "imitation": (("imitation",), "C3"),
}
AXES = {"step": "control steps", "episodes": "episodes"}  # column of log.csv -> label
Log = np.ndarray  # (T,) with the columns of a log.csv as fields


def logs(folders: Iterable[str]) -> list[Log]:
    """The logs of those of these folders of results/ that have one."""
    paths = [ROOT / "results" / folder / "log.csv" for folder in folders]
    return [np.genfromtxt(p, delimiter=",", names=True, ndmin=1) for p in paths if p.exists()]


def levels(axes: plt.Axes, column: str, log: Log, report: dict) -> None:
    """The random pilot, and the paper's 180 % above it."""
    baseline = report["pilots"]["random"]["return"]["value"]
    if column == "validation_steps":
        baseline = log["validation_steps"][-1] / (1 + log["validation_longer"][-1])
        level = (1 + PAPER) * baseline
        axes.axhline(level, color="black", linestyle="--", label="the paper: +180 %")
    axes.axhline(baseline, color="black", linestyle=":", label="random pilot")


def finish(figure: Figure, name: str) -> None:
    """Write one picture."""
    for axes in figure.axes:
        axes.grid(alpha=0.3)
    figure.savefig(ROOT / "figures" / name, dpi=100)
    plt.close(figure)
    print(f"wrote figures/{name}")


def draw_learning(report: dict) -> None:
    """Three panels against control steps, and three against episodes."""
    figure, panels = plt.subplots(2, 3, figsize=(13, 7), sharey="col", layout="constrained")
    for row, (x, text) in zip(panels, AXES.items(), strict=True):
        for axes, (column, title) in zip(row, PANELS.items(), strict=True):
            for label, (folders, colour) in CURVES.items():
                for log in logs(folders):
                    axes.plot(log[x], log[column], colour, label=label, linewidth=1)
            levels(axes, column, log, report)
            axes.set(xlabel=text, xscale="log")
            if x == "step":
                axes.set_title(title, fontsize=11)
    handles, labels = axes.get_legend_handles_labels()
    legend = dict(zip(labels, handles, strict=True))  # each label once
    figure.legend(legend.values(), legend, fontsize=9, ncols=4, loc="outside lower center")
    finish(figure, "learning.png")


def draw_crossed() -> None:
    """The share of validation episodes that cross, a mean over 25,000 control steps."""
    figure, axes = plt.subplots(figsize=(8, 4), layout="constrained")
    for label, (folders, colour) in CURVES.items():
        for seed, log in enumerate(logs(folders)):
            width = max(25_000 // int(log["step"][0]), 1)  # validations in a mean
            share = np.convolve(100 * log["validation_crossed"], np.ones(width) / width, "valid")
            style = {"linestyle": ("-", "--", "-.")[seed], "label": f"{label}, seed {seed}"}
            axes.plot(log["step"][width - 1 :], share, colour, linewidth=1.2, **style)
    laser = json.loads((ROOT / "results/compass.json").read_text())
    for way, line in (("straight on", ":"), ("by compass", "--")):
        y = laser[f"the laser pilot, {way}: crossed, %"]
        axes.axhline(y, color="black", linestyle=line, label=f"the laser pilot, {way}")
    axes.set(title="Crossed in the paper's world, %", xlabel="control steps", ylim=(0, 100))
    figure.legend(fontsize=9, ncols=3, loc="outside lower center")
    finish(figure, "crossed.png")


def draw_looks() -> None:
    """Five tiles a row: what the network sees, and how many of its episodes cross."""
    report = json.loads(looks.RESULT.read_text())
    tiles = [(camera, *item) for camera, flown in looks.LOOKS.items() for item in flown.items()]
    figure, panels = plt.subplots(-(-len(tiles) // 5), 5, figsize=(8.7, 8.5), layout="constrained")
    pose, trunks = np.array([[43.0, -12.85, 0.19]]), [plant(looks.FORESTS[0], World())]
    for axes, (camera, name, look) in zip(panels.flat, tiles, strict=False):
        pilots = [report[pilot][name] for pilot in report if pilot.startswith(camera)]
        shares = " / ".join(f"{100 * pilot['crossed']['value']:.0f}" for pilot in pilots)
        frame = looks.wear(look, pose, trunks, World(camera=camera))[0]
        axes.imshow(frame, "gray", vmin=0, vmax=255)
        axes.set_title(f"{camera}: {name}\ncrossed {shares} %", fontsize=9)
        axes.axis("off")
    finish(figure, "transfer.png")


def main() -> None:
    """The curves, the looks, then the film."""
    report = json.loads((ROOT / "results/eval.json").read_text())
    draw_learning(report)
    draw_crossed()
    draw_looks()
    q, world, name = load_weights(ROOT / "weights/dqn.pt")
    episodes = report["pilots"][name]["episodes"]
    shown = episodes[measure(episodes)["crossed"].argmax()]
    film = ROOT / "figures/flight.gif"
    save_film(film, draw_film(shown, world, q, name), round(1000 * world.dt))
    print("wrote figures/flight.gif")


if __name__ == "__main__":
    main()
