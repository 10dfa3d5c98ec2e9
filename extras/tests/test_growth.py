"""The picture and the film of a training come from its kept validation episodes alone."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from env import World, fly, random_pilot
from extras.experiments.growth import main, read


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A training of 40 steps with four validations in two forests."""
    (tmp_path / "config.json").write_text(json.dumps({"beacon": False, "camera": "grey"}))
    rows = ["step,seconds", *(f"{step},{6 * step}" for step in (1, 3, 10, 20, 40))]
    (tmp_path / "log.csv").write_text("\n".join(rows))
    pilot = random_pilot(np.random.default_rng(0))
    flown = [{"step": step} | e for step in (1, 3, 10, 20, 40) for e in fly(pilot, [5, 6], World())]
    (tmp_path / "validation.jsonl").write_text("".join(json.dumps(e) + "\n" for e in flown))
    return tmp_path


def test_the_four_moments_are_shares_of_the_length(run: Path) -> None:
    world, kept = read(run)
    assert list(kept) == [f"after {step} steps, {step / 10:.0f} min" for step in (1, 3, 10, 40)]
    assert [[e["seed"] for e in episodes] for episodes in kept.values()] == [[5, 6]] * 4
    assert not world.beacon


def test_a_film_shows_every_second_step_of_the_longest_episode_and_stays(run: Path) -> None:
    main(run, run)
    longest = max(episodes[0]["steps"] for episodes in read(run)[1].values())
    with Image.open(run / "growth.gif") as film:
        shown = longest // 2 + 1 + longest % 2  # the start, every second step, and the end
        assert film.n_frames == shown  # the equal ones at the end are one
    with Image.open(run / "growth.png") as image:
        assert image.size == (968, 582)
