"""What does a teacher save, and what does reinforcement learning add to it?

    extras/.venv/bin/python -m extras.experiments.demonstrations train   # an hour; goes on
    extras/.venv/bin/python -m extras.experiments.demonstrations fly     # minutes
    extras/.venv/bin/python -m extras.experiments.demonstrations count   # a quarter of an hour
    extras/.venv/bin/python -m extras.experiments.demonstrations draw

`train` trains each of KINDS with two seeds, on one thread, two at a time, in runs/demos-KIND-SEED.
The demonstrations are 32 flights of the laser pilot. What has been flown is not trained again.
`fly` flies what best.pt keeps, and the laser pilot itself, through the 200 forests of the ladder,
adds them to results/demonstrations.json, and copies logs and settings to results/demos/. `count`
learns from 8 to 512 demonstrated flights alone, with seed 0, and flies the same forests. `draw`
draws figures/demonstrations.png from all that.
"""

import csv
import json
import shutil
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch

from deepflight import DEMOS, configure, dqn_pilot, recall, rehearse, summarize
from dqn import Agent, DQNConfig, load_weights
from env import Flights, World, fly, fly_random, laser_pilot
from extras.experiments.compare import curve
from extras.experiments.ladder import FORESTS, INTERVAL, ROOT, finished, go_on

STEPS, SEEDS, SHOWN, COUNTS = 60_000, (0, 1), 32, (8, 32, 128, 512)
DEMO_FILE, RESULT = ROOT / "runs/demos.json", ROOT / "results/demonstrations.json"
KINDS = {  # label -> flags
    "from scratch": [],
    "demonstrations before": ["--demos", str(DEMO_FILE)],
    "before and during": ["--demos", str(DEMO_FILE), "--demo-share", "0.25"],
    "teacher and TD targets": ["--teacher", "--bellman"],
    "imitation alone": ["--teacher"],
    "before and during, exploring": [
        *("--demos", str(DEMO_FILE), "--demo-share", "0.25", "--epsilon-decay", "40000")
    ],
}
PANELS = {  # figure -> title, factor
    "over_random": ("flight time over random, %", 100),
    "return": ("return by the paper's reward", 1),
    "crossed": ("crossed, %", 100),
    "crash": ("crashed, %", 100),
}


def flown() -> dict[str, dict]:
    """What has been flown: label -> seed -> figure; and by how many demonstrations."""
    return json.loads(RESULT.read_text()) if RESULT.exists() else {}


def trainings() -> Iterator[tuple[str, str, int, list[str]]]:
    """Of every training: its folder's name, its label, its seed and its flags."""
    for i, (label, flags) in enumerate(KINDS.items()):
        for seed in SEEDS:
            yield f"demos-{i}-{seed}", label, seed, ["--steps", str(STEPS), *flags]


def demonstrate(count: int) -> Flights:
    """The first flights of the laser pilot."""
    return fly(laser_pilot(DQNConfig.gamma), range(count), World(), blind=True)


def train_all() -> None:
    """Do all trainings that have not been flown."""
    report = {"beacon": False, "pilots": {"laser": {"flights": demonstrate(SHOWN)}}}
    DEMO_FILE.parent.mkdir(exist_ok=True)
    DEMO_FILE.write_text(json.dumps(report))
    todo = [(name, seed, flags) for name, label, seed, flags in trainings()
            if str(seed) not in flown().get(label, {})]  # fmt: skip
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda training: go_on(*training), todo))


def figures(flights: Flights) -> dict[str, dict]:
    """What `eval` would say of these flights through FORESTS."""
    rng = np.random.default_rng(0)
    bar = fly_random(FORESTS, World(), rng)
    return summarize(flights, bar, rng.integers(len(FORESTS), size=(2000, len(FORESTS))))


def note(label: str, seed: int, flights: Flights) -> None:
    """Add a pilot's figures to the file, and say them."""
    report, found = flown(), figures(flights)
    report.setdefault(label, {})[str(seed)] = found
    RESULT.write_text(json.dumps(report, indent=1) + "\n")
    said = " ".join(f"{key} {found[key]['value']:.3f}" for key in (*PANELS, "goal"))
    print(f"{label}, seed {seed}: {said}", flush=True)


def fly_all() -> None:
    """Fly what is trained and not yet flown; keep logs and settings."""
    world = World()
    if "the teacher itself" not in flown():
        pilot = laser_pilot(DQNConfig.gamma)
        note("the teacher itself", 0, fly(pilot, FORESTS, world, blind=True))
    for name, label, seed, _ in trainings():
        folder, kept = ROOT / "runs" / name, ROOT / "results" / name.replace("-", "/", 1)
        if str(seed) in flown().get(label, {}) or not finished(folder):
            continue
        q = load_weights(folder / "best.pt", World.actions, beacon=False, camera="grey")
        note(label, seed, fly(dqn_pilot(q), FORESTS, world))
        kept.mkdir(parents=True, exist_ok=True)
        for file in ("log.csv", "config.json"):
            shutil.copy(folder / file, kept / file)


def count_all() -> None:
    """Learn from more and more demonstrations, without a step of its own."""
    torch.set_num_threads(1)
    flights, (c, rc) = demonstrate(max(COUNTS)), configure(DEMOS)
    for count in COUNTS:
        lesson = recall([(f["seed"], f["actions"]) for f in flights[:count]], c, rc)
        agent = Agent(c, World.actions, 0)
        rehearse(agent, lesson, c, np.random.default_rng(0))
        note(f"{count} demonstrations", 0, fly(dqn_pilot(agent.q), FORESTS, World()))


def draw() -> None:
    """Four measures: against steps, against minutes, and against the number of demonstrations."""
    report = flown()
    figure, axes = plt.subplots(3, 4, figsize=(13, 9), layout="constrained")
    for column, (key, (title, factor)) in enumerate(PANELS.items()):
        top, mid, low = axes[:, column]
        for i, label in enumerate(KINDS):
            for seed in SEEDS:
                folder, name = ROOT / f"results/demos/{i}-{seed}", label if seed == 0 else None
                step, y = curve(folder, f"test_{key}")
                with (folder / "log.csv").open() as file:
                    minutes = [float(row["seconds"]) / 60 for row in csv.DictReader(file)]
                for panel, x in ((top, step), (mid, minutes)):
                    panel.plot(x, factor * y, f"C{i}", linewidth=1.2, label=name)
        found = [report[f"{count} demonstrations"]["0"][key] for count in COUNTS]
        value, least, most = (factor * np.array([f[x] for f in found]) for x in INTERVAL)
        low.errorbar(COUNTS, value, (value - least, most - value), fmt="o-")
        teacher = factor * report["the teacher itself"]["0"][key]["value"]
        for panel, below in ((top, "control steps"), (mid, "minutes"), (low, "demonstrations")):
            panel.axhline(teacher, color="grey", linestyle=":")
            panel.set(xlabel=below)
            panel.grid(alpha=0.3)
        top.set_title(title, fontsize=11)
        low.set_xscale("log", base=2)
    axes[0, 0].legend(fontsize=8)
    figure.savefig(ROOT / "figures/demonstrations.png", dpi=80)
    print("wrote figures/demonstrations.png")


def main() -> None:
    """One of the four commands."""
    commands = {"train": train_all, "fly": fly_all, "count": count_all, "draw": draw}
    if len(sys.argv) != 2 or sys.argv[1] not in commands:
        sys.exit(
            f"demonstrations: the command is {sys.argv[1:]}, allowed are {', '.join(commands)}"
        )
    commands[sys.argv[1]]()


if __name__ == "__main__":
    main()
