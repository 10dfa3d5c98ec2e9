"""What is each piece of the recipe worth? A ladder from [Mnih15] to the pilot, a flag a rung.

    extras/.venv/bin/python -m extras.experiments.ladder train   # hours; the same command goes on
    extras/.venv/bin/python -m extras.experiments.ladder fly     # minutes; what is trained so far
    extras/.venv/bin/python -m extras.experiments.ladder draw

`train` trains rung 0, Mnih's own settings, for 1.4 million steps, rungs 1 to 7 with two seeds for
100,000, and rung 8, the default recipe, with three. Each has one thread, and two run at a time, in
runs/ladder-RUNG-SEED; those of the recipe in runs/scratch, scratch-1 and scratch-2. Beside the
rungs it trains the controls: rung 7 with another loss or learning rate, and with two seeds, rung 7
without the pieces that do not stand out. What has been flown is not trained again. `fly` flies two
networks of each through 200 forests that no training, test or evaluation uses: what best.pt keeps,
and the newest, which it writes to last.pt. It adds them to results/ladder.json, and copies logs and
settings to results/. `draw` draws figures/ladder.png: a row a rung, a colour a seed, with 95 %
intervals over the forests; a dot is best.pt, and a ring the newest network.
"""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from deepflight import RunConfig, dqn_pilot, summarize
from dqn import DQNConfig, QNetwork, load, load_weights, save_weights
from env import World, fly, fly_random

ROOT = Path(__file__).parents[2]
STEPS, SEEDS = 100_000, (0, 1)
INTERVAL = ("value", "low", "high")
PANELS = {  # figure -> title, factor
    "over_random": ("flight time over random, %", 100),
    "return": ("return by the paper's reward", 1),
    "crossed": ("crossed, %", 100),
}
FORESTS = range(4 * 10**9, 4 * 10**9 + 200)


def back(*names: str) -> list[str]:
    """The flags that set these settings back from a preset's value to the default."""
    flags: list[str] = []
    for name in names:
        value, flag = getattr(DQNConfig if hasattr(DQNConfig, name) else RunConfig, name), "--"
        flag += name.replace("_", "-")
        flags += [flag] if value is True else [flag, str(value)]
    return flags


# label -> the flags that it adds to the rungs above it
RUNGS = {
    "1 textbook DQN": ["--preset", "dqn"],
    "2 + Double": back("double"),
    "3 + five-step returns": back("n_steps"),
    "4 + mirror images": back("mirror"),
    "5 + loss and learning rate": back("huber", "lr_decay"),
    "6 + mean of the weights": back("average"),
    "7 + pay for crossing": back("forward_reward", "goal_value", "far_value"),
}
CONTROLS = {
    "huber 1": ["--huber", "1"],
    "huber 1, a quarter of lr": ["--huber", "1", "--lr", "6e-5"],
    "huber 100": ["--huber", "100"],
    "huber 100, twice the lr": ["--huber", "100", "--lr", "5e-4"],
    "without Double, decay, mean": ["--no-double", "--lr-decay", "1", "--average", "0"],
}


def kept(name: str) -> Path:
    """The folder of a training's settings and log in results/."""
    return ROOT / "results" / name.replace("ladder-", "ladder/")


def flown() -> dict[str, dict[str, dict]]:
    """What has been flown: label -> seed -> network -> figure."""
    path = ROOT / "results/ladder.json"
    return json.loads(path.read_text()) if path.exists() else {}


def trainings() -> Iterator[tuple[str, str, int, list[str]]]:
    """Of every training: its folder's name, its label, its seed and its flags."""
    yield "ladder-0-0", "0 Mnih's settings", 0, ["--preset", "mnih"]
    flags: list[str] = ["--steps", str(STEPS)]
    for label, more in RUNGS.items():
        flags = flags + more
        for seed in SEEDS:
            yield f"ladder-{label[0]}-{seed}", label, seed, flags
    for seed in (*SEEDS, 2):
        yield f"scratch-{seed}".removesuffix("-0"), "8 the recipe", seed, []
    for i, (label, more) in enumerate(CONTROLS.items()):
        for seed in SEEDS if label.startswith("without") else SEEDS[:1]:
            yield f"ladder-{'abcde'[i]}-{seed}", label, seed, ["--steps", str(STEPS), *more]


def train(training: tuple[str, str, int, list[str]]) -> None:
    """Do a training of the ladder unless it has been flown."""
    name, label, seed, flags = training
    if str(seed) not in flown().get(label, {}):
        go_on(name, seed, flags)


def go_on(name: str, seed: int, flags: list[str]) -> None:
    """Train, or go on where an interrupted training stands, or do nothing if it is done."""
    folder = ROOT / "runs" / name
    words = ["--name", name, "--threads", "1", "--seed", str(seed), *flags]
    if finished(folder):
        return
    if (folder / "checkpoint.pt").exists():
        words = ["--resume", str(folder)]
    print(name, flush=True)
    line = [sys.executable, str(ROOT / "deepflight.py"), "train", *words]
    subprocess.run(line, cwd=ROOT, stdout=subprocess.DEVNULL, check=True)


def finished(folder: Path) -> bool:
    """Whether this training has come to its end."""
    if not (folder / "checkpoint.pt").exists():
        return False
    steps = json.loads((folder / "config.json").read_text())["steps"]
    return load(folder / "checkpoint.pt", "checkpoint")["book"]["step"] >= steps


def networks(folder: Path) -> dict[str, QNetwork]:
    """What best.pt keeps, and the newest network, which also goes to last.pt."""
    saved, q = load(folder / "checkpoint.pt", "checkpoint")["agent"], QNetwork(World.actions)
    q.load_state_dict({key: saved["q." + key] for key in q.state_dict()})
    save_weights(folder / "last.pt", q, beacon=False, camera="grey")
    return {
        name: load_weights(folder / f"{name}.pt", World.actions, beacon=False, camera="grey")
        for name in ("best", "last")
    }


def fly_all() -> None:
    """Fly what is trained and not yet flown, write the figures, keep logs and settings."""
    world, rng = World(), np.random.default_rng(0)
    bar = fly_random(FORESTS, world, rng)
    draws = rng.integers(len(FORESTS), size=(2000, len(FORESTS)))  # (2000, forests)
    report = flown()
    for name, label, seed, _ in trainings():
        folder = ROOT / "runs" / name
        if str(seed) in report.get(label, {}) or not finished(folder):
            continue
        flights = {x: fly(dqn_pilot(q), FORESTS, world) for x, q in networks(folder).items()}
        figures = {x: summarize(f, bar, draws) for x, f in flights.items()}
        report.setdefault(label, {})[str(seed)] = figures
        kept(name).mkdir(parents=True, exist_ok=True)
        for file in ("log.csv", "config.json"):
            shutil.copy(folder / file, kept(name) / file)
        for x, y in figures.items():
            said = " ".join(f"{key} {y[key]['value']:.3f}" for key in (*PANELS, "crash", "steps"))
            print(f"{label}, seed {seed}, {x}: {said}", flush=True)
    (ROOT / "results/ladder.json").write_text(json.dumps(report, indent=1) + "\n")


def draw() -> None:
    """Three panels, a row a rung, its seeds one above the other."""
    report = flown()
    rungs = sorted(label for label in report if label not in CONTROLS)
    figure, axes = plt.subplots(1, 3, figsize=(12, 4.5), sharey=True, layout="constrained")
    for panel, (key, (title, factor)) in zip(axes, PANELS.items(), strict=True):
        dots = ((row, x) for row, label in enumerate(rungs) for x in report[label].items())
        for row, (seed, figures) in dots:
            for which, face, shift in (("best", f"C{seed}", 0.0), ("last", "white", 0.12)):
                value, low, high = (factor * figures[which][key][x] for x in INTERVAL)
                y = row + 0.26 * int(seed) - 0.19 + shift
                panel.plot([low, high], [y, y], f"C{seed}", linewidth=1)
                panel.plot(value, y, "o", color=f"C{seed}", markerfacecolor=face, markersize=5)
        panel.set_title(title, fontsize=11)
        panel.grid(alpha=0.3)
    axes[0].set_yticks(range(len(rungs)), rungs)
    axes[0].invert_yaxis()
    figure.savefig(ROOT / "figures/ladder.png", dpi=100)
    print("wrote figures/ladder.png")


def main() -> None:
    """One of the three commands."""
    command = sys.argv[1] if len(sys.argv) == 2 else ""
    if command == "train":
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(train, trainings()))
    elif command in ("fly", "draw"):
        {"fly": fly_all, "draw": draw}[command]()
    else:
        sys.exit(f"ladder: the command is {sys.argv[1:]}, allowed are train, fly and draw")


if __name__ == "__main__":
    main()
