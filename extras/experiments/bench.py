"""Ours and the peers in one run, turn by turn. Ratios, because seconds differ between machines.

    sudo apt-get install xvfb libgl1 libglu1-mesa libgl1-mesa-dri     # MiniWorld draws by OpenGL
    extras/.venv/bin/pip install -r extras/requirements.txt
    xvfb-run -a extras/.venv/bin/python -m extras.experiments.bench   # leave the machine alone

(a) environment steps with their frame, resets included, one core, random actions. Ours: eight
    drones side by side, as in training, and one alone. ViZDoom at 160x120, in an empty maze and
    among monsters; MiniWorld at 84x84, in an empty hallway and in a room strewn with things;
(b) training steps: Stable-Baselines3's DQN, plain 1-step DQN both, the same network, batch,
    updates, threads and 8 environments: float32 both, then our default precision;
(c) bytes that a transition takes in the replay, by its arrays;
(d) growth: a step among 150, 1,500 and 15,000 trunks, equally dense, resets not counted, one core.

A number is the median of five rounds, a ratio the median of the rounds' ratios. Writes
results/bench.json and prints the ratios, which results/README.md shows. The runners are in
peers.py.
"""

import json
import os
import re
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from statistics import median

import numpy as np
import torch

import dqn
from env import VecForest, World
from extras.bridges.sb3_train import make_model
from extras.experiments.peers import DRONES, PLAIN, REPLAY, RNG, doom, forest, ours, rooms, sb3

ROOT, ROUNDS, SECONDS = Path(__file__).parents[2], 5, 4.0
LONG = {"length": 900.0, "grid": (150, 10)}
WIDE = LONG | {"width": 500.0, "grid": (150, 100), "first": (7.5, -247.0)}
FORESTS = {"150": {}, "1,500": LONG, "15,000": WIDE}  # trunks -> the world
OURS = {"eight side by side": partial(forest, 8), "one alone": partial(forest, 1)}
SCENES = {  # of the peers, the emptiest first
    "ViZDoom, my_way_home": partial(doom, "my_way_home"),
    "ViZDoom, deathmatch": partial(doom, "deathmatch"),
    "MiniWorld, Hallway": partial(rooms, "Hallway"),
    "MiniWorld, CollectHealth": partial(rooms, "CollectHealth"),
}
Jobs = dict[str, Callable[[], float]]  # a name -> what gives its steps a second
Given = dict[str, list[float]]  # a job's name -> what it gave, round by round


def rate(steps: Iterator[int]) -> float:
    """Steps a second."""
    next(steps)
    done, start = 0, time.perf_counter()
    while time.perf_counter() - start < SECONDS:
        done += next(steps)
    return done / (time.perf_counter() - start)


def step_rate(envs: VecForest) -> float:
    """Steps a second of one drone, the resets not counted."""
    done, spent = envs.steps, 0.0
    while spent < SECONDS / 3:
        envs.reset_done()
        start = time.perf_counter()
        while envs.active:
            envs.step([int(RNG.integers(9))])
        spent += time.perf_counter() - start
    return (envs.steps - done) / spent


def turns(jobs: Jobs) -> Given:
    """Every job in turn, ROUNDS times."""
    given: Given = {name: [] for name in jobs}
    for _ in range(ROUNDS):
        for name, job in jobs.items():
            given[name].append(job())
            print(f"{name:>40} {given[name][-1]:14,.1f}", flush=True)
    return given


def ratio(given: Given, a: str, b: str) -> float:
    """The median over the rounds of a's rate over b's."""
    return median(x / y for x, y in zip(given[a], given[b], strict=True))


def replay_bytes() -> dict[str, float]:
    """Of a transition, by the arrays of each replay."""
    theirs = vars(make_model(PLAIN, 800).replay_buffer).values()
    replays = {"ours": (REPLAY, vars(dqn.Replay(REPLAY, DRONES)).values()), "sb3": (800, theirs)}
    return {
        name: sum(x.nbytes for x in arrays if isinstance(x, np.ndarray)) / size
        for name, (size, arrays) in replays.items()
    }


def on_one_core() -> tuple[Given, Given]:
    """(a) and (d); a game started from here inherits the one core."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    a = turns({name: partial(rate, runner()) for name, runner in (OURS | SCENES).items()})
    worlds = {f"{n} trunks": VecForest(World(**world), 1, count()) for n, world in FORESTS.items()}
    d = turns({name: partial(step_rate, envs) for name, envs in worlds.items()})
    os.sched_setaffinity(0, cores)
    return a, d


def main() -> None:
    """Run it all, write it, print it."""
    bfloat16 = PLAIN.bfloat16
    (a, d), step, train = on_one_core(), "time of a step:", "training steps a second: ours"
    runners = {"sb3": sb3(), "ours": ours(False)} | ({"bfloat16": ours(True)} if bfloat16 else {})
    torch.set_num_threads(PLAIN.threads)
    torch.set_flush_denormal(True)  # as our training does, for Stable-Baselines3 too
    b, c = turns({name: partial(rate, x) for name, x in runners.items()}), replay_bytes()
    ratios = {
        f"environment steps a second: ours, {way} / {x}": ratio(a, way, x)
        for way in OURS
        for x in SCENES
    }
    ratios[f"{train} / Stable-Baselines3's, float32 both"] = ratio(b, "ours", "sb3")
    if bfloat16:
        other = ratio(b, "bfloat16", "sb3")
        ratios[f"{train} in bfloat16 / Stable-Baselines3's"] = other
    ratios |= {
        "replay bytes a transition: Stable-Baselines3's default / ours": c["sb3"] / c["ours"],
        f"{step} 1,500 / 150 trunks": ratio(d, "150 trunks", "1,500 trunks"),
        f"{step} 15,000 / 150 trunks": ratio(d, "150 trunks", "15,000 trunks"),
    }
    rates = {name: median(x) for part in (a, b, d) for name, x in part.items()}
    cpu = re.search("model name.*: (.*)", Path("/proc/cpuinfo").read_text())[1]
    report = {"machine": cpu, "torch": torch.__version__, "threads": PLAIN.threads}
    report |= {"ratios": ratios, "rates": rates, "bytes": c}
    (ROOT / "results/bench.json").write_text(json.dumps(report, indent=1) + "\n")
    print("\n".join(f"| {name} | {value:.2f} |" for name, value in ratios.items()))


if __name__ == "__main__":
    main()
