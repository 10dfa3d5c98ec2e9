"""What does the control rate do? Random, straight and laser episodes at 10, 30 and 50 Hz.

    .venv/bin/python -m extras.experiments.clock_rate    # ten minutes; no training

The paper does not say how often its drone decides. It trained for 1.4 million control steps in
6,200 episodes, which is 226 steps an episode [DF §III]. Ours flies at 10 Hz. Its random episodes
are much shorter than that, so the paper's clock was quicker, its drone slower or its forest
sparser. Steps of two clocks cannot be compared. How much longer than random an episode is within
one clock can.

The pilots fly the first 200 test forests at each rate; none of these pilots was trained. Writes
results/clock_rate.json.
"""

import json
from pathlib import Path

import numpy as np

from deepflight import TEST_FIRST, Config, fly_random, summarize
from env import World, fly, straight_pilot
from extras.lessons.expert import laser_pilot

ROOT = Path(__file__).parents[2]
SEEDS = range(TEST_FIRST, TEST_FIRST + 200)
RATES = (10, 30, 50)  # Hz
SECONDS = 100  # then an episode is truncated, at every rate
PAPER = 1_400_000 / 6_200  # steps an episode


def fly_at(rate: int) -> dict[str, dict]:
    """The metrics of all three pilots at one control rate, as `eval` gives them."""
    world = World(dt=1 / rate, max_steps=SECONDS * rate)
    gamma = Config.gamma ** (1 / rate / World.dt)  # the same discount a second
    flown = {"random": fly_random(SEEDS, world)}
    for name, pilot in {"straight": straight_pilot, "laser": laser_pilot(gamma)}.items():
        flown[name] = fly(pilot, SEEDS, world, blind=True)
    draws = np.random.default_rng(0).integers(len(SEEDS), size=(2000, len(SEEDS)))
    return {name: summarize(x, flown["random"], draws) for name, x in flown.items()}


def main() -> None:
    """Fly at every rate, print a line a pilot, write it all."""
    report: dict[str, dict] = {}
    for rate in RATES:
        report[str(rate)] = fly_at(rate)
        for name, x in report[str(rate)].items():
            steps, longer, crossed = (x[key]["value"] for key in ("steps", "longer", "crossed"))
            print(
                f"{rate} Hz {name:9} {steps:6.1f} steps, {steps / rate:5.2f} s,"
                f" {longer:+5.0%} longer than random, {crossed:4.0%} crossed",
                flush=True,
            )
    print(f"the paper trained {PAPER:.0f} steps an episode")
    (ROOT / "results/clock_rate.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
