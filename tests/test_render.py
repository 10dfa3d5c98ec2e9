"""What a camera sees, against ray marching, pymunk, and a pinhole camera's closed forms."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pymunk
import pytest
from numpy import ndarray
from pytest import approx

from render import (
    BEARINGS,
    Scene,
    background,
    draw_frame,
    draw_panel,
    paint,
    raycast,
)

SCENE, STEREO = Scene(), Scene(camera="disparity")
RED, BLUE, GREY, PAPER = (220, 20, 60), (65, 105, 225), (128, 128, 128), (0xF4, 0xF4, 0xEE)


def see(
    *trunks: tuple, scene: Scene = SCENE, beacon: tuple | None = None, pose: tuple = (0, 0, 0)
) -> ndarray:
    """What a camera sees (84, 84). beacon: where the pole stands; it is moved to the goal."""
    (x, left), trunks = beacon or (90.0, 0.0), np.array(trunks).reshape(-1, 2)
    scene = replace(scene, beacon=beacon is not None, length=x)
    return draw_frame((pose[0], pose[1] - left, pose[2]), trunks - (0, left), scene)


def painted(frame: ndarray) -> ndarray:
    """The pixels (84, 84) that are neither sky nor ground."""
    return frame != background(SCENE)


def columns(frame: ndarray) -> ndarray:
    return painted(frame).any(0).nonzero()[0]


def random_trunks(rng: np.random.Generator, n: int = 30) -> ndarray:
    """Trunks anywhere around the origin, but not on it: no camera stands inside one."""
    bearing, distance = rng.uniform(-np.pi, np.pi, n), rng.uniform(1.3, 30, n)
    return np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], 1)


def test_a_ray_ends_at_the_first_surface_that_marching_finds() -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        trunks, bearings = random_trunks(rng), rng.uniform(-np.pi, np.pi, 40)
        for bearing, d in zip(bearings, raycast(trunks, 0.5, bearings)[0], strict=True):
            steps = np.append(np.arange(0, min(d, 35), 0.005), min(d, 35))[:, None]  # of 5 mm
            march = steps * [np.cos(bearing), np.sin(bearing)]
            clearance = np.linalg.norm(march[:, None] - trunks, axis=-1).min(1) - 0.5
            assert clearance.min() > -1e-9
            assert d == np.inf or clearance[-1] == approx(0, abs=1e-9)


def test_rays_agree_with_pymunks_segment_query() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        trunks, bearings = random_trunks(rng), rng.uniform(-np.pi, np.pi, 50)
        space = pymunk.Space()
        space.add(*(pymunk.Circle(space.static_body, 0.5, tuple(t)) for t in trunks.tolist()))
        for bearing, d in zip(bearings, raycast(trunks, 0.5, bearings)[0], strict=True):
            end = (50 * np.cos(bearing), 50 * np.sin(bearing))
            hit = space.segment_query_first((0.0, 0.0), end, 0, pymunk.ShapeFilter())
            assert d == approx(50 * hit.alpha if hit else np.inf, abs=1e-6)


def test_a_3_4_5_triangle_and_the_files_own_example_by_hand() -> None:
    distance, cosine = raycast(np.array([[3.0, 0.4]]), 0.5, np.array([0.0]))
    assert (distance[0], cosine[0]) == approx((3 - 0.3, 0.3 / 0.5))
    assert raycast(np.array([[10.0, -0.3]]), 0.5, np.array([0.0]))[0] == approx(9.6)
    d = np.full(84, 9.6)
    rows = paint(np.ones((84, 84)), d, SCENE.trunk_height, 0 * d, SCENE)[:, 41] == 0
    rows = rows.nonzero()[0]
    assert (rows[0], rows[-1]) == (24, 50)


def test_a_known_point_has_its_column_and_row_and_columns_are_equally_spaced_in_tan() -> None:
    assert np.tan(BEARINGS) == approx((41.5 - np.arange(84)) / 42)
    thin = replace(SCENE, trunk_radius=0.3)
    for z, left in ((10.0, -8.0), (10.0, -3.0), (20.0, 1.0), (6.0, 4.5)):
        frame = see((z, left), scene=thin)
        assert abs(columns(frame).mean() - (41.5 - 42 * left / z)) <= 1
        rows = painted(frame)[:, columns(frame)].any(1).nonzero()[0]
        assert abs(rows[0] - (41.5 - 42 * (6 - 2) / z)) <= 1  # the top, 4 m above the camera
        assert abs(rows[-1] - (41.5 + 42 * 2 / z)) <= 1  # the foot, 2 m below


@pytest.mark.parametrize("scene", [SCENE, STEREO])
def test_the_mirrored_forest_gives_the_mirrored_frame_exactly(scene: Scene) -> None:
    rng = np.random.default_rng(2)
    for _ in range(100):
        trunks, (x, y, psi) = random_trunks(rng, 60), rng.uniform(-0.5, 0.5, 3)
        left = rng.uniform(-20, 20)
        frame = see(*trunks, scene=scene, beacon=(30, left), pose=(x, y, 3 * psi))
        other = see(*trunks * [1, -1], scene=scene, beacon=(30, -left), pose=(x, -y, -3 * psi))
        assert (other == frame[:, ::-1]).all()


def test_the_nearest_trunk_is_in_front_and_trunks_fade_with_distance() -> None:
    greys = [see((d, 0.0))[41, 41] for d in (5.0, 15, 25, 35)]
    assert greys == sorted({*greys}) and not painted(see((41.0, 0.0))).any()
    for trunks in ([(6.0, 0.0), (12.0, 0.0)], [(12.0, 0.0), (6.0, 0.0)]):
        assert (see(*trunks) == see((6.0, 0.0))).all()


def test_the_beacon_is_three_pixels_wide_from_afar_and_hidden_by_nearer_trunks() -> None:
    for left in (-40.0, -7.0, 0.0, 0.7, 23.0):
        pole = see(beacon=(90.0, left)) == SCENE.beacon_grey
        assert 3 <= pole.any(0).sum() <= 4
        assert pole[:42].any(1).sum() == approx(42 * 18 / 90, abs=1.1)
    before, behind, at = (5.0, 0.0), (20.0, 0.0), (10.0, 0.0)
    assert see(before, beacon=at)[41, 41] == see(before)[41, 41] != SCENE.beacon_grey
    assert see(behind, beacon=at)[41, 41] == SCENE.beacon_grey


def test_disparity_halves_when_depth_doubles_whatever_the_distance_along_the_ray() -> None:
    for depth in (1.0, 2.5, 5.0, 10.0, 20.0, 39.0):
        # Column 41 looks along y = t * z, and meets the circle where (z - x)^2 + (t * z)^2 = 0.25.
        x, t = depth + 0.5, 0.5 / 42
        z = (x - np.sqrt(0.25 * (1 + t * t) - (t * x) ** 2)) / (1 + t * t)
        assert see((x, 0.0), scene=STEREO)[41, 41] == int(min(255 * 2 / z, 255))
    side = see((10.0, 8.0), scene=STEREO)[:42]  # above the horizon all else is 0
    distance, _ = raycast(np.array([[10.0, 8.0]]), 0.5, BEARINGS)
    for i in side.any(0).nonzero()[0][1:-1]:
        assert {*side[:, i]} - {0} == {int(255 * 2 / (distance[i] * np.cos(BEARINGS[i])))}


def test_the_grounds_disparity_grows_in_a_straight_line_from_the_horizon_down() -> None:
    ground = see(scene=STEREO)[:, 0]
    assert not ground[:42].any()  # the sky is infinitely far
    for row in range(42, 84):  # depth = altitude * 42 / (row - 41.5), by similar triangles
        assert ground[row] == int(255 * STEREO.near * (row - 41.5) / (42 * STEREO.altitude))


def test_a_film_shows_frame_trunks_path_and_values() -> None:
    drone = SimpleNamespace(
        observation=see((6.0, 1.0))[None], trunks=np.array([[45.0, 10.0]]), outcome="crash"
    )
    path, q = np.array([[0.0, 0.0], [9.0, 0.0]]), np.array([5.0, 7.0, 6.0])
    panel = draw_panel(drone, path, q, "text").convert("RGB")
    nearest = ((np.arange(232) + 0.5) * 84 / 232).astype(int)
    shown = np.asarray(panel)[:232, :232, 0].astype(int)  # some pixels mix two
    assert np.abs(shown - drone.observation[0][np.ix_(nearest, nearest)]).mean() < 4
    x, y = 496 / 2, 232 / 2  # px, of the start: the map has 4 px a metre
    for ahead, left, colour in ((45, 10, GREY), (45, -10, PAPER), (5, 0, RED), (9, 0, RED)):
        found = panel.getpixel((x + 4 * ahead, y - 4 * left))
        assert np.abs(np.subtract(found, colour)).max() < 12  # of 64 colours
    heights = [
        int((np.abs(np.asarray(panel)[240:306, 14 + 25 * (2 - a)] - np.int16(c)) < 12).all(1).sum())
        for a, c in enumerate((GREY, BLUE, GREY))
    ]
    assert heights == approx([2, 62, 32], abs=2)  # the worst has the lowest bar, the chosen is blue
