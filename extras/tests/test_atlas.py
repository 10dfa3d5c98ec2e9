"""The atlas bends the world as it says, and names the cause of a crash by what can be checked."""

from dataclasses import replace

import pytest

from env import World, fly, plant, straight_pilot
from extras.experiments.atlas import cause, forest


def test_density_1_at_5_metres_a_second_is_the_papers_forest() -> None:
    assert forest(1.0, 5.0, False) == World()


@pytest.mark.parametrize("density", [0.5, 0.75, 1.5, 2.0])
def test_trunks_grow_in_number_with_density_on_the_same_ground(density: float) -> None:
    trunks = plant(0, replace(forest(density, 5.0, False), jitter=(0.0, 0.0)))
    assert len(trunks) == pytest.approx(150 * density, rel=0.07)
    assert 86 < trunks[:, 0].max() < 92.5
    assert 21 < trunks[:, 1].max() < 24.5


def test_who_flies_straight_into_a_trunk_has_seen_it_and_could_have_turned() -> None:
    for episode in fly(straight_pilot, range(10), World(), blind=True):
        assert episode["outcome"] == "crash"
        assert cause(episode, World()) in ("careless", "trapped")
