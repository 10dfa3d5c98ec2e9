"""Looks change what the camera delivers, and never where a trunk stands."""

from dataclasses import asdict

import numpy as np
import pytest

import env
from env import World, plant
from extras.experiments.looks import LOOKS, STEREO, Look, draw_look, seeing, wear, wear_at_random
from render import background, draw_frames

POSES = np.array([[0.0, 0.0, 0.0], [30.0, 3.0, 0.5], [70.0, -9.0, -2.0]])
FORESTS = [plant(seed, World()) for seed in range(3)]
GREY, DEPTH = World(), World(camera="disparity")


@pytest.mark.parametrize("world", [GREY, DEPTH])
def test_the_plain_look_is_what_the_camera_draws(world: World) -> None:
    assert (wear(Look(), POSES, FORESTS, world) == draw_frames(POSES, FORESTS, world)).all()


@pytest.mark.parametrize("name", [name for name in LOOKS if name != "plain"])
def test_every_look_changes_a_grey_frame(name: str) -> None:
    seen = wear(LOOKS[name], POSES, FORESTS, GREY)
    assert (seen != draw_frames(POSES, FORESTS, GREY)).mean() > 0.01


@pytest.mark.parametrize("name", [n for n, look in LOOKS.items() if "view" not in look.scene])
def test_but_for_the_air_no_look_changes_disparity(name: str) -> None:
    assert (wear(LOOKS[name], POSES, FORESTS, DEPTH) == draw_frames(POSES, FORESTS, DEPTH)).all()


def test_haze_ends_the_view_of_a_stereo_camera_and_leaves_what_is_near() -> None:
    plain = draw_frames(POSES, FORESTS, DEPTH)
    thick = wear(LOOKS["thick haze"], POSES, FORESTS, DEPTH)
    far = plain < 255 * DEPTH.near / 15  # farther than haze lets it see
    assert (thick[~far] == plain[~far]).all()
    assert (thick[far] <= plain[far]).all()


@pytest.mark.parametrize("name", STEREO)
def test_every_stereo_error_changes_disparity_and_leaves_the_sky_above_most_trunks(
    name: str,
) -> None:
    seen, plain = wear(STEREO[name], POSES, FORESTS, DEPTH), draw_frames(POSES, FORESTS, DEPTH)
    assert (seen != plain).mean() > 0.005
    assert (seen[:, 0] == 0).mean() > 0.3


def test_rings_stand_on_trunks_alone() -> None:
    plain = draw_frames(POSES, FORESTS, GREY)
    seen = wear(LOOKS["striped bark"], POSES, FORESTS, GREY)
    trunk = draw_frames(POSES, FORESTS, DEPTH) > background(DEPTH)
    assert (seen == plain)[~trunk].all()
    assert 0.2 < (seen != plain)[trunk].mean() < 0.8


def test_a_whole_step_of_disparity_is_a_multiple_of_its_levels() -> None:
    seen = wear(STEREO["whole steps"], POSES, FORESTS, DEPTH)
    assert (seen % STEREO["whole steps"].quantum == 0).all()


def test_holes_are_inside_trunks_and_a_filled_one_has_a_depth() -> None:
    plain = draw_frames(POSES, FORESTS, DEPTH)
    open_, filled = (wear(STEREO[n], POSES, FORESTS, DEPTH) for n in ("holes", "holes, filled"))
    hole = (open_ == 0) & (plain > 0)
    assert hole.any()
    assert (plain > background(DEPTH))[hole].all()
    assert (filled[hole] > 0).all()


@pytest.mark.parametrize("world", [GREY, DEPTH])
def test_a_look_at_random_is_a_function_of_forest_and_pose(world: World) -> None:
    together = wear_at_random(POSES, FORESTS, world)
    alone = [wear_at_random(POSES[i : i + 1], [FORESTS[i]], world)[0] for i in range(3)]
    assert (together == alone).all()
    assert (wear_at_random(POSES[:1], FORESTS[1:2], world) != together[0]).any()


@pytest.mark.parametrize(("kind", "flown"), [("grey", LOOKS), ("disparity", STEREO)])
def test_the_ranges_of_training_hold_every_look_that_is_flown(kind: str, flown: dict) -> None:
    rng = np.random.default_rng(0)
    drawn = [flat(draw_look(kind, rng)) for _ in range(3000)]
    for look in map(flat, flown.values()):
        for key, value in look.items():
            values = [d[key] for d in drawn if key in d]
            assert min(values) <= value <= max(values), key


def flat(look: Look) -> dict[str, float]:
    """The numbers of a look, those of its scene among them."""
    numbers = asdict(look)
    return numbers.pop("scene") | numbers


def test_the_eyes_are_given_back() -> None:
    plain = env.draw_frames
    with pytest.raises(KeyError), seeing(wear_at_random):
        assert env.draw_frames is wear_at_random
        raise KeyError
    assert env.draw_frames is plain
