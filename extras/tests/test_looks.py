"""Looks change what the camera delivers, and never where a trunk stands."""

import json
from dataclasses import asdict

import numpy as np
import pytest

import deepflight
import env
from env import VecForest, World, plant
from extras.lessons import looks
from extras.lessons.looks import Look, LooksConfig, random_look, seeing, wear, wear_at_random
from render import background, draw_frame

POSES = (0.0, 0.0, 0.0), (30.0, 3.0, 0.5), (70.0, -9.0, -2.0)
FORESTS = [plant(seed, World()) for seed in range(3)]
GREY, DEPTH = World(), World(camera="disparity")
LIGHT, STEREO = looks.LOOKS["grey"], looks.LOOKS["disparity"]
HAZES = ("plain", "no haze", "thick haze")


def drawn(world: World) -> np.ndarray:
    """What the camera draws at the three poses (3, 84, 84)."""
    return np.array([draw_frame(*place, world) for place in zip(POSES, FORESTS, strict=True)])


def worn(look: Look, world: World) -> np.ndarray:
    """The same in this look."""
    return np.array([wear(look, *place, world) for place in zip(POSES, FORESTS, strict=True)])


@pytest.mark.parametrize("world", [GREY, DEPTH])
def test_the_plain_look_is_what_the_camera_draws(world: World) -> None:
    assert (worn(Look(), world) == drawn(world)).all()


@pytest.mark.parametrize("name", [name for name in LIGHT if name != "plain"])
def test_every_look_changes_a_grey_frame(name: str) -> None:
    seen = worn(LIGHT[name], GREY)
    assert (seen != drawn(GREY)).mean() > 0.01


@pytest.mark.parametrize("name", [n for n in LIGHT if n not in HAZES])
def test_but_for_the_air_no_look_changes_disparity(name: str) -> None:
    assert (worn(LIGHT[name], DEPTH) == drawn(DEPTH)).all()


def test_haze_ends_the_view_of_a_stereo_camera_and_leaves_what_is_near() -> None:
    plain = drawn(DEPTH)
    thick = worn(LIGHT["thick haze"], DEPTH)
    far = plain < 255 * DEPTH.near / 15  # farther than haze lets it see
    assert (thick[~far] == plain[~far]).all()
    assert (thick[far] <= plain[far]).all()


@pytest.mark.parametrize("name", [name for name in STEREO if name not in HAZES])
def test_every_stereo_error_changes_disparity_and_leaves_the_sky_above_most_trunks(
    name: str,
) -> None:
    seen, plain = worn(STEREO[name], DEPTH), drawn(DEPTH)
    assert (seen != plain).mean() > 0.005
    assert (seen[:, 0] == 0).mean() > 0.3


def test_rings_stand_on_trunks_alone() -> None:
    plain = drawn(GREY)
    seen = worn(LIGHT["striped bark"], GREY)
    trunk = drawn(DEPTH) > background(DEPTH)
    assert (seen == plain)[~trunk].all()
    assert 0.2 < (seen != plain)[trunk].mean() < 0.8


def test_a_whole_step_of_disparity_is_a_multiple_of_its_levels() -> None:
    seen = worn(STEREO["whole steps"], DEPTH)
    assert (seen % STEREO["whole steps"].quantum == 0).all()


def test_holes_are_inside_trunks_and_a_filled_one_has_a_depth() -> None:
    plain = drawn(DEPTH)
    open_, filled = (worn(STEREO[n], DEPTH) for n in ("holes", "holes, filled"))
    hole = (open_ == 0) & (plain > 0)
    assert hole.any()
    assert (plain > background(DEPTH))[hole].all()
    assert (filled[hole] > 0).all()


@pytest.mark.parametrize("world", [GREY, DEPTH])
def test_a_look_at_random_is_a_function_of_forest_and_pose(world: World) -> None:
    for pose, forest, other in zip(POSES, FORESTS, reversed(FORESTS), strict=True):
        frame = wear_at_random(pose, forest, world)
        assert (frame == wear_at_random(pose, forest, world)).all()
        assert (frame != wear_at_random(pose, other, world)).any() == (other is not forest)


@pytest.mark.parametrize("camera", looks.LOOKS)
def test_the_ranges_of_training_hold_every_look_that_is_flown(camera: str) -> None:
    rng = np.random.default_rng(0)
    found = [flat(random_look(camera, rng)) for _ in range(3000)]
    haze = HAZES if camera == "disparity" else ()
    flown = [look for name, look in looks.LOOKS[camera].items() if name not in haze]
    for look in map(flat, flown):
        for key, value in look.items():
            values = [d[key] for d in found if key in d]
            assert min(values) <= value <= max(values), key


def flat(look: Look) -> dict[str, float]:
    """The numbers of a look, those of its scene among them."""
    numbers = asdict(look)
    return numbers.pop("scene") | numbers


def test_the_eyes_are_given_back() -> None:
    plain = env.draw_frame
    with pytest.raises(KeyError), seeing(wear_at_random):
        assert env.draw_frame is wear_at_random
        raise KeyError
    assert env.draw_frame is plain


def test_the_drones_of_a_training_see_random_looks_and_others_do_not() -> None:
    c = LooksConfig(steps=8)
    envs = VecForest(World(), c.num_envs, range(c.num_envs))
    loop = LooksConfig.train(c, envs, np.random.default_rng(0), deepflight.shaped_reward)
    next(loop)
    seen = envs.reset_done()[:, -1]  # (L, 84, 84)
    forests = [drone.trunks for drone in envs.drones]
    worn = [wear_at_random((0.0, 0.0, 0.0), forest, World()) for forest in forests]
    assert (seen == worn).all()
    loop.close()
    plain = VecForest(World(), c.num_envs, range(c.num_envs)).reset_done()[:, -1]
    assert (plain == [draw_frame((0.0, 0.0, 0.0), forest, World()) for forest in forests]).all()
    assert (plain != seen).mean() > 0.1


def test_the_numbers_of_the_header() -> None:
    bright = Look({"trunk_facing": 220, "trunk_grazing": 220})
    trunk = np.array([[9.0, 0.0]])  # its surface is 8.5 m away
    grey = (Look(), GREY, 46), (bright, GREY, 192)
    depth = (Look(), DEPTH, 60), (bright, DEPTH, 60), (STEREO["whole steps"], DEPTH, 52)
    for look, world, level in (*grey, *depth):
        frame = wear(look, (0.0, 0.0, 0.0), trunk, world)
        assert int(frame[41, 41]) == pytest.approx(level, abs=1)


def test_the_page_shows_what_was_flown() -> None:
    report = json.loads(looks.RESULT.read_text())
    assert [*report] == [*looks.PILOTS]
    page = (looks.ROOT / "results/README.md").read_text()
    for name in LIGHT | STEREO:
        cells = (flown[name]["crossed"]["value"] if name in flown else None
                 for flown in report.values())  # fmt: skip
        line = "".join(" |" if x is None else f" {100 * x:.1f} |" for x in cells)
        assert f"| {name} |{line}\n" in page
