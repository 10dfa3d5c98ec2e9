"""Draw the README's pictures from results/: the paper's Figures 2 to 4, and more.

    extras/.venv/bin/pip install -r extras/requirements.txt
    extras/.venv/bin/python -m extras.experiments.figures

figures/learning.png: the three trainings of weights/dqn.pt's recipe.
figures/transfer.png: the looks of extras/lessons/looks.py, each with the % that cross, by the
shipped pilot and by the one that was trained with random looks.
figures/flight.gif: the first episode of results/eval.json that crosses, flown again, with the
values that weights/dqn.pt gives to each turn.
"""

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from deepflight import load_weights, measure, save_film
from env import World, plant
from extras.experiments.maps import SEEDS
from extras.lessons import looks

ROOT = Path(__file__).parents[2]
PAPER = 1.8  # the paper's figure: 180 % more flight time than random [DF, abstract]
PANELS = {  # column of log.csv -> title, factor
    "train_return": ("Return in training, with random actions: mean of 100 episodes", 1),
    "validation_return": ("Return in validation: mean of 48 episodes", 1),
    "validation_steps": ("Steps of an episode in validation", 1),
    "validation_crossed": ("Crossed the forest in validation, %", 100),
}


def levels(axes: plt.Axes, column: str, factor: float, report: dict) -> None:
    """The random pilot, and the paper's 180 % above it."""
    baseline = factor * report["pilots"]["random"][column.split("_")[1]]["value"]
    if column == "validation_steps":
        label = f"the paper: {PAPER:.0%} longer than random"
        axes.axhline((1 + PAPER) * baseline, color="black", linestyle="--", label=label)
    axes.axhline(baseline, color="black", linestyle=":", label="random actions")


def finish(figure: Figure, name: str) -> None:
    """Write one picture."""
    for axes in figure.axes:
        axes.grid(alpha=0.3)
    figure.savefig(ROOT / "figures" / name, dpi=100)
    plt.close(figure)
    print(f"wrote figures/{name}")


def draw_learning(report: dict) -> None:
    """Four panels against control steps, with one line a seed."""
    figure, panels = plt.subplots(2, 2, figsize=(11, 6.5), sharex=True, layout="constrained")
    for axes, (column, (title, factor)) in zip(panels.flat, PANELS.items(), strict=True):
        for seed, folder in enumerate(("dqn", "dqn-1", "dqn-2")):
            log = np.genfromtxt(ROOT / f"results/{folder}/log.csv", delimiter=",", names=True)
            axes.plot(log["step"], factor * log[column], SEEDS[seed], label=f"DQN, seed {seed}")
        levels(axes, column, factor, report)
        axes.set_title(title, fontsize=11)
    for axes in panels[1]:
        axes.set_xlabel("control steps")
        axes.set_xticks(ticks := range(0, 200_001, 50_000), [f"{x:,}" for x in ticks])
    figure.legend(*panels[1, 0].get_legend_handles_labels(), ncols=5, loc="outside lower center")
    finish(figure, "learning.png")


def draw_looks() -> None:
    """Five tiles a row: what the network sees, and how many of its episodes cross."""
    report = json.loads(looks.RESULT.read_text())
    tiles = [(camera, *item) for camera, flown in looks.LOOKS.items() for item in flown.items()]
    figure, panels = plt.subplots(-(-len(tiles) // 5), 5, figsize=(8.7, 9.1), layout="constrained")
    pose, trunks = (43.0, -12.85, 0.19), plant(looks.FORESTS[0], World())
    for axes, (camera, name, look) in zip(panels.flat, tiles, strict=False):
        pilots = [report[pilot][name] for pilot in report if pilot.startswith(camera)]
        shares = " / ".join(rf"$\bf{{{100 * x['crossed']['value']:.0f}}}$" for x in pilots)
        axes.imshow(looks.wear(look, pose, trunks, World(camera=camera)), "gray", vmin=0, vmax=255)
        axes.set_title(f"{camera}: {name}\ncrossed {shares} %", fontsize=10)
        axes.axis("off")
    title = "What the network sees, and the % of episodes that cross: of the pilot that trained\n"
    figure.suptitle(title + "with the plain look / of the one that trained with random looks")
    finish(figure, "transfer.png")


def main() -> None:
    """The curves, the looks, then the film."""
    report = json.loads((ROOT / "results/eval.json").read_text())
    draw_learning(report)
    draw_looks()
    q, world, name = load_weights(ROOT / "weights/dqn.pt")
    episodes = report["pilots"][name]["episodes"]
    shown = episodes[measure(episodes)["crossed"].argmax()]
    save_film(ROOT / "figures/flight.gif", shown, world, q, name)
    print("wrote figures/flight.gif")


if __name__ == "__main__":
    main()
