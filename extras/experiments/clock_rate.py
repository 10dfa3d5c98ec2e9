"""What does the control rate do? Random, straight and laser flights at 10, 30 and 50 Hz.

    .venv/bin/python -m extras.experiments.clock_rate    # ten minutes; no training

The paper does not say how often its drone decides. It trained for 1.4 million control steps in
6,200 episodes, which is 226 steps an episode [DF §III]. Ours flies at 10 Hz. Its random flights are
much shorter than that, so the paper's clock was quicker, its drone slower or its forest sparser.
Steps of two clocks cannot be compared. A flight time over random's within one clock can.

The pilots fly the same 200 forests at each rate. No training, test or evaluation uses these.
Writes results/clock_rate.json.
"""

import json
from pathlib import Path

import numpy as np

from deepflight import summarize
from dqn import DQNConfig
from env import World, fly, fly_random, laser_pilot, straight_pilot

ROOT = Path(__file__).parents[2]
SEEDS = range(4 * 10**9, 4 * 10**9 + 200)
RATES = (10, 30, 50)  # Hz
SECONDS = 100  # then a flight is truncated, at every rate
PAPER = 1_400_000 / 6_200  # steps an episode


def fly_at(rate: int) -> dict[str, dict]:
    """The figures of all three pilots at one control rate, as `eval` gives them."""
    world, rng = World(dt=1 / rate, max_steps=SECONDS * rate), np.random.default_rng(0)
    bar = fly_random(SEEDS, world, rng)
    gamma = DQNConfig.gamma ** (1 / rate / World.dt)  # the same discount a second
    pilots = {"straight": straight_pilot, "laser": laser_pilot(gamma)}
    flights = {name: fly(pilots[name], SEEDS, world, blind=True) for name in pilots}
    draws = rng.integers(len(SEEDS), size=(2000, len(SEEDS)))  # (2000, forests)
    return {name: summarize(x, bar, draws) for name, x in ({"random": bar} | flights).items()}


def main() -> None:
    """Fly at every rate, print a line a pilot, write it all."""
    report: dict[str, dict] = {}
    for rate in RATES:
        report[str(rate)] = fly_at(rate)
        for name, x in report[str(rate)].items():
            steps, over, crossed = (x[key]["value"] for key in ("steps", "over_random", "crossed"))
            print(
                f"{rate} Hz {name:9} {steps:6.1f} steps, {steps / rate:5.2f} s,"
                f" {over:+5.0%} over random, {crossed:4.0%} crossed",
                flush=True,
            )
    print(f"the paper trained {PAPER:.0f} steps an episode")
    (ROOT / "results/clock_rate.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
