"""What does an expert save, and what does reinforcement learning add to it?

    extras/.venv/bin/python -m extras.experiments.demonstrations train   # an hour; goes on
    extras/.venv/bin/python -m extras.experiments.demonstrations fly     # minutes
    extras/.venv/bin/python -m extras.experiments.demonstrations count   # a quarter of an hour
    extras/.venv/bin/python -m extras.experiments.demonstrations draw

`train` trains each of KINDS with two seeds, on one thread, two at a time, in runs/demos-KIND-SEED.
The demonstrations are 32 episodes of the laser pilot. What has been flown is not trained again.
`fly` flies what best.pt keeps, and the laser pilot itself, through the 200 forests of the ladder,
adds them to results/demonstrations.json, and copies logs and settings to results/demos/. `count`
learns from 8 to 512 demonstrated episodes alone, with seed 0, and flies the same forests. `draw`
draws figures/demonstrations.png from all that.
"""

import csv
import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch

from deepflight import Config, dqn_pilot, load_weights, shaped_reward
from dqn import Agent
from env import Episode, World, fly
from extras.experiments.compare import curve
from extras.experiments.ladder import (
    FORESTS,
    INTERVAL,
    RECIPE,
    ROOT,
    Training,
    finished,
    go_on,
    keep,
    main,
    metrics,
)
from extras.lessons.demonstrations import DemoConfig, load_demos, pretrain
from extras.lessons.expert import laser_pilot

STEPS, SEEDS, SHOWN, COUNTS = 60_000, (0, 1), 32, (8, 32, 128, 512)
DEMO_FILE, RESULT = ROOT / "runs/demos.json", ROOT / "results/demonstrations.json"
EXPERT = ("-m", "extras.lessons.expert")
DEMOS, FILE = ("-m", "extras.lessons.demonstrations"), ("--demos", "runs/demos.json")
KINDS = {  # label -> program, flags
    "from scratch": (RECIPE, ()),
    "demonstrations before": (DEMOS, FILE),
    "before and during": (DEMOS, (*FILE, "--demo-share", "0.25")),
    "expert and TD targets": (EXPERT, ("--bellman",)),
    "imitation alone": (EXPERT, ()),
    "before and during, exploring": (
        DEMOS, (*FILE, "--demo-share", "0.25", "--epsilon-decay", "40000"),
    ),
}  # fmt: skip
PANELS = {  # metric -> title, factor
    "longer": ("longer than random, %", 100),
    "return": ("return by the paper's reward", 1),
    "crossed": ("crossed, %", 100),
    "crash": ("crashed, %", 100),
}


def flown() -> dict[str, dict]:
    """What has been flown: label -> seed -> metric; and by how many demonstrations."""
    return json.loads(RESULT.read_text()) if RESULT.exists() else {}


def trainings() -> Iterator[Training]:
    """All trainings of the comparison."""
    for i, (label, (program, flags)) in enumerate(KINDS.items()):
        for seed in SEEDS:
            flags_of_all = ("--steps", str(STEPS), *flags)
            yield Training(f"demos-{i}-{seed}", label, seed, program, flags_of_all)


def demonstrate(count: int) -> list[Episode]:
    """The first episodes of the laser pilot."""
    return fly(laser_pilot(Config.gamma), range(count), World(), blind=True)


def train_all() -> None:
    """Do all trainings that have not been flown."""
    report = flown()
    DEMO_FILE.parent.mkdir(exist_ok=True)
    DEMO_FILE.write_text(json.dumps({"pilots": {"laser": {"episodes": demonstrate(SHOWN)}}}))
    todo = [x for x in trainings() if str(x.seed) not in report.get(x.label, {})]
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(go_on, todo))


def note(label: str, seed: int, episodes: list[Episode]) -> None:
    """Add a pilot's metrics to the file, and say them."""
    report, found = flown(), metrics(episodes)
    report.setdefault(label, {})[str(seed)] = found
    RESULT.write_text(json.dumps(report, indent=1) + "\n")
    said = " ".join(f"{key} {found[key]['value']:.3f}" for key in (*PANELS, "goal"))
    print(f"{label}, seed {seed}: {said}", flush=True)


def fly_all() -> None:
    """Fly what is trained and not yet flown; keep logs and settings."""
    if "the expert itself" not in flown():
        note("the expert itself", 0, fly(laser_pilot(Config.gamma), FORESTS, World(), blind=True))
    for training in trainings():
        if str(training.seed) in flown().get(training.label, {}) or not finished(training.folder):
            continue
        q, world, _ = load_weights(training.folder / "best.pt")
        note(training.label, training.seed, fly(dqn_pilot(q), FORESTS, world))
        keep(training)


def count_all() -> None:
    """Learn from more and more demonstrations, without a step of its own."""
    torch.set_num_threads(1)
    c, world, episodes = DemoConfig(), World(), demonstrate(max(COUNTS))
    for count in COUNTS:
        demo_replay = load_demos(episodes[:count], c, world, shaped_reward)
        agent = Agent(c, World.num_actions, np.random.default_rng(0))
        pretrain(agent, demo_replay, c, np.random.default_rng(0))
        note(f"{count} demonstrations", 0, fly(dqn_pilot(agent.q), FORESTS, world))


def draw() -> None:
    """Four measures: against steps, against minutes, and against the number of demonstrations."""
    report = flown()
    figure, axes = plt.subplots(3, 4, figsize=(13, 9), layout="constrained")
    for column, (key, (title, factor)) in enumerate(PANELS.items()):
        top, mid, low = axes[:, column]
        for i, label in enumerate(KINDS):
            for seed in SEEDS:
                folder, name = ROOT / f"results/demos/{i}-{seed}", label if seed == 0 else None
                step, y = curve(folder, f"validation_{key}")
                with (folder / "log.csv").open() as file:
                    minutes = [float(row["seconds"]) / 60 for row in csv.DictReader(file)]
                for panel, x in ((top, step), (mid, minutes)):
                    panel.plot(x, factor * y, f"C{i}", linewidth=1.2, label=name)
        found = [report[f"{count} demonstrations"]["0"][key] for count in COUNTS]
        value, least, most = (factor * np.array([f[x] for f in found]) for x in INTERVAL)
        low.errorbar(COUNTS, value, (value - least, most - value), fmt="o-")
        expert = factor * report["the expert itself"]["0"][key]["value"]
        for panel, below in ((top, "control steps"), (mid, "minutes"), (low, "demonstrations")):
            panel.axhline(expert, color="grey", linestyle=":")
            panel.set(xlabel=below)
            panel.grid(alpha=0.3)
        top.set_title(title, fontsize=11)
        low.set_xscale("log", base=2)
    axes[0, 0].legend(fontsize=8)
    figure.savefig(ROOT / "figures/demonstrations.png", dpi=80)
    print("wrote figures/demonstrations.png")


if __name__ == "__main__":
    main({"train": train_all, "fly": fly_all, "count": count_all, "draw": draw})
