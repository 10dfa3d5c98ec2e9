"""How soon does a training from rewards pass the paper's +180 %, and how soon does imitation cross?

    .venv/bin/python -m extras.experiments.clock    # leave the machine alone: ten minutes

Trains seeds in turn. After every 5,000 control steps the clock stands still, and the newest weights
fly through 200 forests that no training and no validation uses. The first to pass the bar there
count. Writes results/clock.json. A question that has its answer there is not asked again.
"""

import json
import time
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np

import dqn
from deepflight import Config, Run, dqn_pilot, fly_random, summarize
from env import World, fly
from extras.lessons import expert

ROOT = Path(__file__).parents[2]
RESULT = ROOT / "results/clock.json"
FORESTS, EVERY = range(5 * 10**9, 5 * 10**9 + 200), 5_000  # control steps


class Question(NamedTuple):
    """When does a training pass a bar?"""

    config: type[Config]
    metric: str
    bar: float
    seeds: int  # seeds 0, 1, ...


QUESTIONS = {
    "from rewards": Question(Config, "longer", 1.8, 5),
    "imitation": Question(expert.ExpertConfig, "crossed", 0.5, 3),
}


def answer(asked: Question, seed: int) -> dict[str, float]:
    """The step and the seconds of the first weights that pass; ValueError if none do."""
    baseline, draws = fly_random(FORESTS, World()), np.arange(len(FORESTS))[None]
    run = Run(asked.config(seed=seed), Path())  # it writes nothing there
    seconds, start = 0.0, time.perf_counter()
    for _ in run.loop:
        if dqn.due(EVERY, step := run.envs.steps, run.c.num_envs):
            seconds += time.perf_counter() - start
            episodes = fly(dqn_pilot(run.agent.q), FORESTS, World())
            found = summarize(episodes, baseline, draws)[asked.metric]["value"]
            print(f"seed {seed}: {found:.0%} at step {step:,}, {seconds:.1f} s", flush=True)
            if found > asked.bar:
                return {"step": step, "seconds": seconds, asked.metric: found}
            start = time.perf_counter()
    raise ValueError(f"seed {seed} does not pass within {run.c.steps:,} steps")


def main() -> None:
    """Take every time, write them all."""
    report = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    for name, asked in QUESTIONS.items():
        if name in report:
            continue
        seeds = {str(seed): answer(asked, seed) for seed in range(asked.seeds)}
        report[name] = {"median": median(x["seconds"] for x in seeds.values()), "seeds": seeds}
        RESULT.write_text(json.dumps(report, indent=1) + "\n")
        print(f"{name}: median {report[name]['median']:.1f} s", flush=True)


if __name__ == "__main__":
    main()
