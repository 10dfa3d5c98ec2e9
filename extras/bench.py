"""Ours and the peers in one run, turn by turn: ratios first, for seconds differ between machines.

    sudo apt-get install xvfb libgl1 libglu1-mesa libgl1-mesa-dri     # MiniWorld draws by OpenGL
    extras/.venv/bin/pip install -r extras/requirements.txt
    xvfb-run -a extras/.venv/bin/python -m extras.bench               # leave the machine alone

(a) environment steps with their frame, resets included, one core, random actions: ViZDoom at
    160x120, in an empty maze and among monsters, and MiniWorld at 84x84, in an empty hallway and
    in a room strewn with things;
(b) training steps: Stable-Baselines3's DQN, plain 1-step DQN both, the same network, batch,
    updates, threads and 8 environments: float32 both, then our default precision;
(c) bytes that a transition takes in the replay, by its arrays;
(d) growth: a step among 150, 1,500 and 15,000 trunks, equally dense, resets not counted, one core;
    and an update of Double DQN in float32 against the batch, and against its floor, the time that
    its multiplications alone take at the rate of this machine's product of matrices.

A figure is the median of five rounds, a ratio the median of the rounds' ratios. Writes
results/bench.json and prints the README's table. The runners are in peers.py.
"""

import json
import os
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median

import numpy as np
import torch

from deepflight import PRECISION, Config
from dqn import Replay
from env import ForestEnv, World
from extras.peers import (
    PLAIN,
    REPLAY,
    RNG,
    doom,
    forest,
    products,
    rooms,
    sb3,
    training,
    updates,
)
from extras.sb3_train import make_model

ROOT, ROUNDS, SECONDS = Path(__file__).parent.parent, 5, 4.0
LONG = {"length": 900.0, "rows": 150}
WIDE = LONG | {"width": 500.0, "columns": 100, "first_y": -247.0}
FORESTS = {150: {}, 1_500: LONG, 15_000: WIDE}  # trunks -> the world
BATCHES = (32, 128, 512)
# Multiplications for one state, layer by layer, in five passes: forward Q(s), Q(s2) and Q^(s2), and
# backward to the weights and to what came in, which for the first layer is not needed
FLOOR = 4 * 400 * 32 * 256 + 5 * (81 * 64 * 512 + 49 * 64 * 576 + 3136 * 512 + 512 * 9)
SCENES = {  # of the peers, the emptiest first
    "ViZDoom, my_way_home": doom("my_way_home"),
    "ViZDoom, deathmatch": doom("deathmatch"),
    "MiniWorld, Hallway": rooms("Hallway"),
    "MiniWorld, CollectHealth": rooms("CollectHealth"),
}
Given = dict[str, list[float]]  # a job's name -> what it gave, round by round


def rate(steps: Iterator[int]) -> float:
    """Steps a second."""
    next(steps)
    done, start = 0, time.perf_counter()
    while time.perf_counter() - start < SECONDS:
        done += next(steps)
    return done / (time.perf_counter() - start)


def flight_rate(env: ForestEnv) -> float:
    """Steps a second, the resets not counted."""
    done, spent = 0, 0.0
    while spent < SECONDS / 3:
        env.reset()
        start = time.perf_counter()
        while not env.outcome:
            env.step(int(RNG.integers(9)))
        spent += time.perf_counter() - start
        done += len(env.actions)
    return done / spent


def turns(job: Callable[[object], float], runners: dict[str, object]) -> Given:
    """Every runner in turn, ROUNDS times."""
    given: Given = {name: [] for name in runners}
    for _ in range(ROUNDS):
        for name, runner in runners.items():
            given[name].append(job(runner))
            print(f"{name:>40} {given[name][-1]:14,.1f}", flush=True)
    return given


def ratio(given: Given, a: str, b: str) -> float:
    """The median over the rounds of a's figure over b's."""
    return median(x / y for x, y in zip(given[a], given[b], strict=True))


def replay_bytes() -> dict[str, float]:
    """Of a transition, by the arrays of each replay."""
    theirs = vars(make_model(Config(**PLAIN), 800).replay_buffer).values()
    replays = {"ours": vars(Replay(REPLAY, 8)).values(), "sb3": theirs}
    size = {"ours": REPLAY, "sb3": 800}
    return {
        name: sum(x.nbytes for x in arrays if isinstance(x, np.ndarray)) / size[name]
        for name, arrays in replays.items()
    }


def main() -> None:
    """Run it all, write it, print it."""
    torch.set_num_threads(Config.threads)
    torch.set_flush_denormal(True)  # as our training does, for Stable-Baselines3 too
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})  # a game started from here inherits the one core
    a = turns(rate, {"forest": forest(), **SCENES})
    growth = {f"{n} trunks": ForestEnv(World(**world)) for n, world in FORESTS.items()}
    d = turns(flight_rate, growth)
    os.sched_setaffinity(0, cores)
    ours = {f"ours {p}": training(p) for p in dict.fromkeys(("float32", PRECISION))}
    b = turns(rate, {"sb3": sb3(), **ours})
    e = turns(rate, {str(n): updates(n) for n in BATCHES} | {"products": products()})
    c, default = replay_bytes(), f"ours {PRECISION}"
    figures = {f"environment steps a second: ours / {x}": ratio(a, "forest", x) for x in SCENES}
    train, step = "training steps a second: ours", "time of a step:"
    figures |= {
        f"{train} / Stable-Baselines3's, float32 both": ratio(b, "ours float32", "sb3"),
        f"{train} in {PRECISION} / Stable-Baselines3's": ratio(b, default, "sb3"),
        "replay bytes a transition: Stable-Baselines3's default / ours": c["sb3"] / c["ours"],
        f"{step} 1,500 / 150 trunks": ratio(d, "150 trunks", "1500 trunks"),
        f"{step} 15,000 / 150 trunks": ratio(d, "150 trunks", "15000 trunks"),
    }
    for n in BATCHES:
        floors = [r * FLOOR * n / m for r, m in zip(e[str(n)], e["products"], strict=True)]
        figures[f"time of an update of {n}: multiplications alone / measured"] = median(floors)
    rates = {name: median(x) for part in (a, b, d, e) for name, x in part.items()}
    cpu = re.search("model name.*: (.*)", Path("/proc/cpuinfo").read_text())[1]
    report = {"machine": cpu, "torch": torch.__version__, "threads": Config.threads}
    report |= {"figures": figures, "rates": rates, "bytes": c}
    (ROOT / "results/bench.json").write_text(json.dumps(report, indent=1) + "\n")
    print("\n".join(f"| {name} | {figure:.2f} |" for name, figure in figures.items()))


if __name__ == "__main__":
    main()
