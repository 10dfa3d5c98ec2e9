"""What is each piece of the recipe worth? A ladder from [Mnih15] to the pilot, a flag a rung.

    extras/.venv/bin/python -m extras.experiments.ladder train   # hours; the same command goes on
    extras/.venv/bin/python -m extras.experiments.ladder fly     # minutes; what is trained so far
    extras/.venv/bin/python -m extras.experiments.ladder draw

`train` trains rung 0, Mnih's own settings, for 1.4 million steps, rungs 1 to 7 with two seeds for
100,000, and rung 8, the default recipe, with three. Each has one thread, and two run at a time, in
runs/ladder-RUNG-SEED; those of the recipe in runs/dqn, dqn-1 and dqn-2. Beside the rungs it trains
controls: rung 7 with another loss or learning rate, and with two seeds, rung 7 without the pieces
that do not stand out. What has been flown is not trained again. `fly` flies two networks of each
through 200 forests: what best.pt keeps, and the newest, which it writes to last.pt. It adds them to
results/ladder.json, and copies logs and settings to results/. `draw` draws figures/ladder.png: a
row a rung, with 95 % intervals over the forests.
"""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from deepflight import Config, dqn_pilot, load, load_weights, save_weights, summarize
from dqn import QNetwork
from env import World, fly
from extras.experiments.maps import SEEDS as COLOURS

ROOT = Path(__file__).parents[2]
STEPS, SEEDS = 100_000, (0, 1)
PANELS = {  # metric -> title, factor
    "steps": ("steps of an episode", 1),
    "return": ("return by the paper's reward", 1),
    "crossed": ("crossed, %", 100),
}
NETWORKS = {"best": "best.pt", "last": "newest weights"}
FORESTS = range(4 * 10**9, 4 * 10**9 + 200)  # no training uses them
RECIPE, MNIH = ("deepflight.py",), ("-m", "extras.lessons.mnih")  # programs that train


def back(*names: str) -> tuple[str, ...]:
    """The flags that set these settings of the textbook back to the recipe's defaults."""
    flags: list[str] = []
    for name in names:
        value, flag = getattr(Config, name), "--" + name.replace("_", "-")
        flags += [flag] if value is True else [flag, str(value)]
    return tuple(flags)


# label -> the flags that it adds to the rungs above it
RUNGS = {
    "1 textbook DQN": (),
    "2 + Double": back("double"),
    "3 + five-step returns": back("n_steps"),
    "4 + mirror images": back("mirror"),
    "5 + loss and learning rate": back("huber_delta", "lr_final"),
    "6 + mean of the weights": back("swa_fraction"),
    "7 + shaped reward": back("forward_reward", "goal_bonus", "far_bonus"),
}
CONTROLS = {
    "huber 1": ("--huber-delta", "1"),
    "huber 1, a quarter of lr": ("--huber-delta", "1", "--lr", "6e-5"),
    "huber 100": ("--huber-delta", "100"),
    "huber 100, twice the lr": ("--huber-delta", "100", "--lr", "5e-4"),
    "without Double, decay, mean": ("--no-double", "--lr-final", "1", "--swa-fraction", "0"),
}


class Training(NamedTuple):
    """One training of an experiment."""

    name: str  # of its folder in runs/
    label: str
    seed: int
    program: tuple[str, ...]
    flags: tuple[str, ...] = ()

    @property
    def folder(self) -> Path:
        """Where it trains."""
        return ROOT / "runs" / self.name

    @property
    def kept(self) -> Path:
        """Where its settings and log are kept."""
        name = self.name.replace("-", "/", 1) if self.name[:3] != "dqn" else self.name
        return ROOT / "results" / name


def trainings() -> Iterator[Training]:
    """All trainings of the ladder."""
    yield Training("ladder-0-0", "0 Mnih's settings", 0, MNIH)
    flags = ("--steps", str(STEPS))
    for label, more in RUNGS.items():
        flags += more
        for seed in SEEDS:
            yield Training(f"ladder-{label[0]}-{seed}", label, seed, (*MNIH, "textbook"), flags)
    for seed in (*SEEDS, 2):
        yield Training(f"dqn-{seed}".removesuffix("-0"), "8 the recipe", seed, RECIPE)
    for letter, (label, more) in zip("abcde", CONTROLS.items(), strict=True):
        for seed in SEEDS if label.startswith("without") else SEEDS[:1]:
            flags = ("--steps", str(STEPS), *more)
            yield Training(f"ladder-{letter}-{seed}", label, seed, RECIPE, flags)


def flown() -> dict[str, dict[str, dict]]:
    """What has been flown: label -> seed -> network -> metric."""
    path = ROOT / "results/ladder.json"
    return json.loads(path.read_text()) if path.exists() else {}


def go_on(training: Training) -> None:
    """Train, or go on where an interrupted training stands, or do nothing if it is done."""
    if finished(training.folder):
        return
    words = ("--name", training.name, "--threads", "1", "--seed", str(training.seed))
    words += training.flags
    if (training.folder / "checkpoint.pt").exists():
        words = ("--resume", str(training.folder))
    print(training.name, flush=True)
    line = [sys.executable, *training.program, "train", *words]
    subprocess.run(line, cwd=ROOT, stdout=subprocess.DEVNULL, check=True)


def train_all() -> None:
    """Do all trainings that have not been flown, two at a time."""
    report = flown()
    todo = [x for x in trainings() if str(x.seed) not in report.get(x.label, {})]
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(go_on, todo))


def finished(folder: Path) -> bool:
    """Whether this training has come to its end."""
    if not (folder / "checkpoint.pt").exists():
        return False
    saved = load(folder / "checkpoint.pt", "config", "actions")
    return len(saved["actions"]) * saved["config"]["num_envs"] >= saved["config"]["steps"]


def networks(folder: Path) -> dict[str, QNetwork]:
    """What best.pt keeps, and the newest network, which also goes to last.pt."""
    agent, q = load(folder / "checkpoint.pt", "agent")["agent"], QNetwork(World.num_actions)
    q.load_state_dict({key: agent["q." + key] for key in q.state_dict()})
    save_weights(folder / "last.pt", q, Config())
    return {name: load_weights(folder / f"{name}.pt")[0] for name in ("best", "last")}


def metrics(episodes: list[dict]) -> dict[str, dict]:
    """What `eval` would say of these episodes through FORESTS."""
    # Not `longer`: no random episodes are flown here.
    return {key: x for key, x in summarize(episodes, episodes).items() if key != "longer"}


def keep(training: Training) -> None:
    """Copy a training's log and settings to results/."""
    training.kept.mkdir(parents=True, exist_ok=True)
    for file in ("log.csv", "config.json"):
        shutil.copy(training.folder / file, training.kept / file)


def fly_all() -> None:
    """Fly what is trained and not yet flown, write the metrics, keep logs and settings."""
    report = flown()
    for training in trainings():
        seeds = report.setdefault(training.label, {})
        if str(training.seed) in seeds or not finished(training.folder):
            continue
        pilots = {which: dqn_pilot(q) for which, q in networks(training.folder).items()}
        found = {which: metrics(fly(pilots[which], FORESTS, World())) for which in pilots}
        seeds[str(training.seed)] = found
        keep(training)
        for which, y in found.items():
            said = " ".join(f"{key} {y[key]['value']:.3f}" for key in (*PANELS, "crash"))
            print(f"{training.label}, seed {training.seed}, {which}: {said}", flush=True)
    report = {label: seeds for label, seeds in report.items() if seeds}
    (ROOT / "results/ladder.json").write_text(json.dumps(report, indent=1) + "\n")


def draw() -> None:
    """Three panels, a row a rung, its seeds one above the other."""
    report = flown()
    rungs = sorted(label for label in report if label not in CONTROLS)
    figure, axes = plt.subplots(1, 3, figsize=(10, 5), sharey=True, layout="constrained")
    for panel, (key, (title, factor)) in zip(axes, PANELS.items(), strict=True):
        dots = ((row, x) for row, label in enumerate(rungs) for x in report[label].items())
        for row, (seed, found) in dots:
            colour = COLOURS[int(seed)]
            for which, face, shift in (("best", colour, 0.0), ("last", "white", 0.12)):
                value, low, high = (factor * x for x in found[which][key].values())
                y = row + 0.26 * int(seed) - 0.19 + shift
                panel.plot([low, high], [y, y], colour, linewidth=1)
                label = f"seed {seed}, {NETWORKS[which]}"
                panel.plot(value, y, "o", color=colour, mfc=face, markersize=5, label=label)
        panel.set_title(title, fontsize=11)
        panel.grid(alpha=0.3)
    axes[0].set_yticks(range(len(rungs)), rungs)
    axes[0].invert_yaxis()
    dots = {dot.get_label(): dot for dot in axes[0].lines if dot.get_label()[0] == "s"}
    figure.legend(handles=[dots[x] for x in sorted(dots)], ncols=3, loc="outside lower center")
    figure.savefig(ROOT / "figures/ladder.png", dpi=100)
    print("wrote figures/ladder.png")


def main(commands: dict[str, Callable]) -> None:
    """One of these commands."""
    if len(sys.argv) != 2 or sys.argv[1] not in commands:
        sys.exit(f"the command is {sys.argv[1:]}, allowed are {', '.join(commands)}")
    commands[sys.argv[1]]()


if __name__ == "__main__":
    main({"train": train_all, "fly": fly_all, "draw": draw})
