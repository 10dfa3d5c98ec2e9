"""What the eyes see, against marching, pymunk, and a pinhole camera's closed forms."""

from pathlib import Path

import numpy as np
import pymunk
import pytest
from PIL import Image

from render import (
    BEARINGS,
    FOCAL,
    SLOPES,
    Scene,
    backdrop,
    camera,
    draw_map,
    raycast,
    save_film,
)

SCENE = Scene()
EYE = (0.0, 0.0)


def random_trunks(rng: np.random.Generator, n: int = 30) -> np.ndarray:
    """Circles anywhere around the origin, none around it: the eye is never inside a trunk."""
    bearing, distance = rng.uniform(-np.pi, np.pi, n), rng.uniform(1.3, 30, n)
    return np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], 1)


def painted(frame: np.ndarray) -> np.ndarray:
    """Pixels (84, 84) bool that are neither sky nor ground."""
    return frame != backdrop(SCENE)


def test_rays_stop_at_the_first_bark_that_marching_finds() -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        trunks, bearings = random_trunks(rng), rng.uniform(-np.pi, np.pi, 40)
        distance, _ = raycast(trunks, 0.5, bearings)
        for bearing, d in zip(bearings, distance, strict=True):
            ray = np.array([np.cos(bearing), np.sin(bearing)])
            march = np.arange(0, min(d, 35), 0.005)[:, None] * ray  # centimetre by half centimetre
            assert clearance(march, trunks).min() > -1e-9
            if d < np.inf:
                assert clearance(d * ray[None], trunks)[0] == pytest.approx(0, abs=1e-9)


def clearance(points: np.ndarray, trunks: np.ndarray) -> np.ndarray:
    """Distance (P,) from points (P, 2) to the nearest bark, by comparing with every trunk."""
    return np.linalg.norm(points[:, None] - trunks, axis=-1).min(1) - 0.5


def test_rays_agree_with_pymunks_segment_queries() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        trunks, bearings = random_trunks(rng), rng.uniform(-np.pi, np.pi, 50)
        space = pymunk.Space()
        space.add(*(pymunk.Circle(space.static_body, 0.5, tuple(t)) for t in trunks.tolist()))
        distance, _ = raycast(trunks, 0.5, bearings)
        for bearing, d in zip(bearings, distance, strict=True):
            end = (50 * np.cos(bearing), 50 * np.sin(bearing))
            hit = space.segment_query_first(EYE, end, 0, pymunk.ShapeFilter())
            assert d == pytest.approx(50 * hit.alpha if hit else np.inf, abs=1e-6)


def test_facing_is_the_cosine_between_ray_and_normal() -> None:
    distance, facing = raycast(np.array([[3.0, 0.4]]), 0.5, np.array([0.0]))
    # The ray passes the centre at 0.4 m, a 3-4-5 triangle with the radius 0.5: 0.3 / 0.5.
    assert distance[0] == pytest.approx(3 - 0.3)
    assert facing[0] == pytest.approx(0.6)


def test_an_empty_forest_hits_nothing() -> None:
    distance, facing = raycast(np.empty((0, 2)), 0.5, BEARINGS)
    assert np.isinf(distance).all()
    assert not facing.any()


@pytest.mark.parametrize("d", [3.0, 5.0, 10.0, 20.0, 35.0])
def test_a_trunk_straight_ahead_has_its_analytic_width_and_height(d: float) -> None:
    seen = painted(camera(EYE, 0.0, np.array([[d, 0.0]]), SCENE))
    half_width = FOCAL * 0.5 / np.sqrt(d**2 - 0.25)  # px: the tangent of asin(radius / d)
    assert abs(seen.any(0).sum() - 2 * half_width) <= 1
    depth = d - 0.5  # m, to the middle columns
    top, foot = min(FOCAL * (6 - 2) / depth, 42), min(FOCAL * 2 / depth, 42)
    assert abs(seen[:, 41].sum() - (top + foot)) <= 1
    assert abs(seen[:42, 41].sum() - top) <= 1


def test_columns_are_those_of_a_pinhole_and_not_of_equal_angles() -> None:
    for left in (-8.0, -3.0, 1.0, 7.5):
        columns = painted(camera(EYE, 0.0, np.array([[10.0, left]]), SCENE)).any(0).nonzero()[0]
        assert abs(columns.mean() - (41.5 - FOCAL * left / 10)) <= 1


def test_walls_at_one_depth_stand_equally_tall_wherever_they_stand() -> None:
    frame = painted(camera(EYE, 0.0, np.array([[12.0, 0.0], [12.0, 9.0]]), SCENE))
    heights = frame.sum(0)
    middle, side = heights[35:49].max(), heights[:20].max()
    assert abs(int(middle) - int(side)) <= 1  # along the ray it would be 20 % farther


def test_a_trunk_at_positive_y_stands_in_the_left_half() -> None:
    columns = painted(camera(EYE, 0.0, np.array([[10.0, 3.0]]), SCENE)).any(0).nonzero()[0]
    assert len(columns)
    assert columns.max() < 42
    assert SLOPES[0] > 0


def test_a_left_turn_moves_the_forest_to_the_right() -> None:
    trunk = np.array([[10.0, 0.0]])
    columns = painted(camera(EYE, 0.3, trunk, SCENE)).any(0).nonzero()[0]
    assert columns.min() >= 42


def test_the_mirrored_world_gives_the_mirrored_frame_exactly() -> None:
    rng = np.random.default_rng(2)
    for _ in range(200):
        trunks, (x, y), heading = random_trunks(rng, 60), rng.uniform(-0.5, 0.5, 2), rng.normal()
        beacon = (30.0, rng.uniform(-20, 20))
        frame = camera((x, y), heading, trunks, SCENE, beacon)
        mirrored = camera((x, -y), -heading, trunks * [1, -1], SCENE, (beacon[0], -beacon[1]))
        assert (mirrored == frame[:, ::-1]).all()


def test_the_nearest_trunk_wins() -> None:
    near, far = np.array([[6.0, 0.0]]), np.array([[12.0, 0.0]])
    both = camera(EYE, 0.0, np.concatenate([far, near]), SCENE)
    assert (both == camera(EYE, 0.0, near, SCENE)).all()


def test_trunks_fade_with_distance_until_the_view_ends() -> None:
    greys = [camera(EYE, 0.0, np.array([[d, 0.0]]), SCENE)[41, 41] for d in (5.0, 15, 25, 35, 41)]
    assert greys == sorted(greys)
    assert not painted(camera(EYE, 0.0, np.array([[41.0, 0.0]]), SCENE)).any()


def test_bark_is_darker_where_it_is_seen_edge_on() -> None:
    row = camera(EYE, 0.0, np.array([[4.0, 0.0]]), SCENE)[41]
    assert row[41] > row[37]


def test_the_beacon_is_three_pixels_wide_from_across_the_forest() -> None:
    for left in (-40.0, -7.0, 0.0, 0.7, 23.0):
        pole = camera(EYE, 0.0, np.empty((0, 2)), SCENE, beacon=(90.0, left)) == SCENE.beacon_grey
        assert 3 <= pole.any(0).sum() <= 4
        assert pole[:42].any(1).sum() == pytest.approx(FOCAL * 18 / 90, abs=1.1)
    assert min(abs(SCENE.beacon_grey - g) for g in (SCENE.sky, SCENE.trunk_facing)) >= 50


def test_the_beacon_is_hidden_by_nearer_trunks_and_hides_farther_ones() -> None:
    before, behind = np.array([[5.0, 0.0]]), np.array([[20.0, 0.0]])
    hidden = camera(EYE, 0.0, before, SCENE, beacon=(10.0, 0.0))
    assert hidden[41, 41] == camera(EYE, 0.0, before, SCENE)[41, 41]
    shown = camera(EYE, 0.0, behind, SCENE, beacon=(10.0, 0.0))
    assert shown[41, 41] == SCENE.beacon_grey


def test_the_map_shows_trunks_start_and_goal_where_they_are() -> None:
    image = draw_map(
        np.array([[45.0, 10.0]]), (90, 50), [(np.array([[0, 0], [5, 0]]), "crash", "")]
    )
    assert image.getpixel(((45 + 4) * 8, (25 + 4 - 10) * 8)) == (0x5B, 0x5B, 0x50)
    assert image.getpixel(((45 + 4) * 8, (25 + 4 + 10) * 8)) == (0xF2, 0xF2, 0xEA)
    assert image.getpixel(((2 + 4) * 8, (25 + 4) * 8)) == (0xD6, 0x27, 0x28)


def test_the_gif_has_one_picture_a_frame(tmp_path: Path) -> None:
    trunk = np.array([[20.0, 0.5]])
    frames = [camera((x, 0.0), 0.0, trunk, SCENE) for x in range(5)]
    maps = [draw_map(trunk, (90, 50), [(np.array([[x, 0]]), "", "")]) for x in range(5)]
    save_film(tmp_path / "f.gif", frames, maps, 100)
    with Image.open(tmp_path / "f.gif") as gif:
        assert gif.n_frames == 5
