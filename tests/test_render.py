"""What the eyes see, against marching, pymunk, and a pinhole camera's closed forms."""

import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pymunk
import pytest
from PIL import Image

from render import (
    BEARINGS,
    FOCAL,
    PANEL,
    SLOPES,
    Point,
    Scene,
    backdrop,
    camera,
    draw_map,
    draw_panel,
    draw_ways,
    raycast,
    save_film,
    silhouette,
)

SCENE = Scene()
EYE = (0.0, 0.0)
RED, GREY = (0xD6, 0x27, 0x28), (0x9A, 0x9A, 0x90)


def see(
    at: Point, heading: float, trunks: np.ndarray, scene: Scene, beacon: Point | None = None
) -> np.ndarray:
    """What one eye sees (84, 84)."""
    return camera(np.array([[*at, heading]]), [trunks], scene, beacon)[0]


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


def test_the_ray_of_the_files_own_example_meets_bark_at_9_6_m() -> None:
    distance, _ = raycast(np.array([[10.0, 0.3]]), 0.5, np.array([0.0]))
    assert distance[0] == pytest.approx(9.6)
    column = silhouette(np.full(84, 9.6), SCENE.trunk_height, SCENE)[:, 41]
    rows = column.nonzero()[0]
    assert (rows[0], rows[-1]) == (24, 50)  # column 41 looks 0.7 degrees off, where top is 23.998


def test_an_empty_forest_hits_nothing() -> None:
    distance, facing = raycast(np.empty((0, 2)), 0.5, BEARINGS)
    assert np.isinf(distance).all()
    assert not facing.any()


@pytest.mark.parametrize("d", [3.0, 5.0, 10.0, 20.0, 35.0])
def test_a_trunk_straight_ahead_has_its_analytic_width_and_height(d: float) -> None:
    seen = painted(see(EYE, 0.0, np.array([[d, 0.0]]), SCENE))
    half_width = FOCAL * 0.5 / np.sqrt(d**2 - 0.25)  # px: the tangent of asin(radius / d)
    assert abs(seen.any(0).sum() - 2 * half_width) <= 1
    depth = d - 0.5  # m, to the middle columns
    top, foot = min(FOCAL * (6 - 2) / depth, 42), min(FOCAL * 2 / depth, 42)
    assert abs(seen[:, 41].sum() - (top + foot)) <= 1
    assert abs(seen[:42, 41].sum() - top) <= 1


def test_a_column_shows_bark_wherever_its_ray_meets_any() -> None:
    rng = np.random.default_rng(6)
    for _ in range(200):
        trunks, turn = random_trunks(rng, 10), rng.uniform(-np.pi, np.pi)
        distance, _ = raycast(trunks, 0.5, BEARINGS + turn)
        assert (painted(see(EYE, turn, trunks, SCENE)).any(0) == (distance < np.inf)).all()


def test_columns_are_those_of_a_pinhole_and_not_of_equal_angles() -> None:
    for left in (-8.0, -3.0, 1.0, 7.5):
        columns = painted(see(EYE, 0.0, np.array([[10.0, left]]), SCENE)).any(0).nonzero()[0]
        assert abs(columns.mean() - (41.5 - FOCAL * left / 10)) <= 1


def test_walls_at_one_depth_stand_equally_tall_wherever_they_stand() -> None:
    frame = painted(see(EYE, 0.0, np.array([[12.0, 0.0], [12.0, 9.0]]), SCENE))
    heights = frame.sum(0)
    middle, side = heights[35:49].max(), heights[:20].max()
    assert abs(int(middle) - int(side)) <= 1  # along the ray it would be 20 % farther


def test_a_trunk_at_positive_y_stands_in_the_left_half() -> None:
    columns = painted(see(EYE, 0.0, np.array([[10.0, 3.0]]), SCENE)).any(0).nonzero()[0]
    assert len(columns)
    assert columns.max() < 42
    assert SLOPES[0] > 0


def test_a_left_turn_moves_the_forest_to_the_right() -> None:
    trunk = np.array([[10.0, 0.0]])
    columns = painted(see(EYE, 0.3, trunk, SCENE)).any(0).nonzero()[0]
    assert columns.min() >= 42


def test_the_mirrored_world_gives_the_mirrored_frame_exactly() -> None:
    rng = np.random.default_rng(2)
    for _ in range(200):
        trunks, (x, y), heading = random_trunks(rng, 60), rng.uniform(-0.5, 0.5, 2), rng.normal()
        beacon = (30.0, rng.uniform(-20, 20))
        frame = see((x, y), heading, trunks, SCENE, beacon)
        mirrored = see((x, -y), -heading, trunks * [1, -1], SCENE, (beacon[0], -beacon[1]))
        assert (mirrored == frame[:, ::-1]).all()


def test_the_nearest_trunk_wins() -> None:
    near, far = np.array([[6.0, 0.0]]), np.array([[12.0, 0.0]])
    both = see(EYE, 0.0, np.concatenate([far, near]), SCENE)
    assert (both == see(EYE, 0.0, near, SCENE)).all()


def test_trunks_fade_with_distance_until_the_view_ends() -> None:
    greys = [see(EYE, 0.0, np.array([[d, 0.0]]), SCENE)[41, 41] for d in (5.0, 15, 25, 35, 41)]
    assert greys == sorted(greys)
    assert not painted(see(EYE, 0.0, np.array([[41.0, 0.0]]), SCENE)).any()


def test_bark_is_darker_where_it_is_seen_edge_on() -> None:
    row = see(EYE, 0.0, np.array([[4.0, 0.0]]), SCENE)[41]
    assert row[41] > row[37]


def test_the_beacon_is_three_pixels_wide_from_across_the_forest() -> None:
    for left in (-40.0, -7.0, 0.0, 0.7, 23.0):
        pole = see(EYE, 0.0, np.empty((0, 2)), SCENE, beacon=(90.0, left)) == SCENE.beacon_grey
        assert 3 <= pole.any(0).sum() <= 4
        assert pole[:42].any(1).sum() == pytest.approx(FOCAL * 18 / 90, abs=1.1)
    assert min(abs(SCENE.beacon_grey - g) for g in (SCENE.sky, SCENE.trunk_facing)) >= 50


def test_the_beacon_is_hidden_by_nearer_trunks_and_hides_farther_ones() -> None:
    before, behind = np.array([[5.0, 0.0]]), np.array([[20.0, 0.0]])
    hidden = see(EYE, 0.0, before, SCENE, beacon=(10.0, 0.0))
    assert hidden[41, 41] == see(EYE, 0.0, before, SCENE)[41, 41]
    shown = see(EYE, 0.0, behind, SCENE, beacon=(10.0, 0.0))
    assert shown[41, 41] == SCENE.beacon_grey


# -------------------------------------------------- disparity

STEREO = Scene(camera="disparity")


def test_disparity_halves_when_depth_doubles_and_is_cut_at_near() -> None:
    for depth in (1.0, 2.5, 5.0, 10.0, 20.0, 39.0):
        x = depth + 0.5  # m, the trunk's middle, dead ahead
        value = see(EYE, 0.0, np.array([[x, 0.0]]), STEREO)[41, 41]
        # column 41 looks along y = t * z, and meets the circle where (z - x)^2 + (t * z)^2 = 0.25
        t = 0.5 / 42
        z = (x - np.sqrt(0.25 * (1 + t * t) - (t * x) ** 2)) / (1 + t * t)
        assert value == int(min(255 * 2 / z, 255))


def test_all_of_an_upright_wall_in_one_column_has_one_disparity_by_depth_and_not_by_distance() -> (
    None
):
    side = see(EYE, 0.0, np.array([[10.0, 8.0]]), STEREO)  # far off the axis
    columns = (side != backdrop(STEREO))[:42].any(0).nonzero()[0]
    for i in columns[1:-1]:
        distance, _ = raycast(np.array([[10.0, 8.0]]), 0.5, BEARINGS[i : i + 1])
        depth = distance[0] * np.cos(BEARINGS[i])
        rows = side[:42, i] > 0  # above the horizon there is nothing else
        assert set(side[:42, i][rows]) == {int(255 * 2 / depth)}


def test_the_grounds_disparity_rises_in_a_straight_line_from_the_horizon_down() -> None:
    ground = see(EYE, 0.0, np.empty((0, 2)), STEREO)[:, 0]
    assert (ground[:42] == 0).all(), "the sky is infinitely far"
    for row in range(42, 84):  # depth = altitude * 42 / (row - 41.5), by similar triangles
        assert ground[row] == int(255 * STEREO.near * (row - 41.5) / (42 * STEREO.altitude))
    assert 250 <= ground[83] < 255, "so none of it is cut"


def test_disparity_knows_no_colour() -> None:
    trunks, pole = random_trunks(np.random.default_rng(4)), (15.0, 2.0)
    colours = {"sky": 200, "ground": 10, "trunk_facing": 90, "trunk_grazing": 250}
    other = replace(STEREO, beacon_grey=7, **colours)
    assert (see(EYE, 0.0, trunks, STEREO, pole) == see(EYE, 0.0, trunks, other, pole)).all()


def test_both_cameras_see_the_same_silhouettes() -> None:
    # without haze, and with bark that neither sky nor ground resembles
    plain = Scene(view=1e4, sky=0, ground=0, trunk_facing=200, trunk_grazing=200, beacon_grey=255)
    rng = np.random.default_rng(5)
    for _ in range(50):
        trunks, pole = random_trunks(rng, 10), (30.0, rng.uniform(-20, 20))
        grey = see(EYE, 0.0, trunks, plain, pole)
        stereo = see(EYE, 0.0, trunks, replace(plain, camera="disparity"), pole)
        assert ((grey > 0)[:42] == (stereo > 0)[:42]).all()


def test_the_pole_has_its_own_disparity_and_nearer_trunks_hide_it() -> None:
    pole = (20.0, 0.0)
    alone = see(EYE, 0.0, np.empty((0, 2)), STEREO, pole)
    assert alone[20, 41] == int(255 * 2 / 19), "its bark is one radius nearer than its middle"
    assert see(EYE, 0.0, np.array([[6.0, 0.0]]), STEREO, pole)[41, 41] == int(255 * 2 / 5.5)


# -------------------------------------------------- many eyes at once


@pytest.mark.parametrize("beacon", [None, (30.0, 4.0)])
def test_many_eyes_in_one_call_see_what_each_sees_alone(beacon: Point | None) -> None:
    rng = np.random.default_rng(3)
    for eyes in (1, 2, 3, 8, 33):
        forests = [random_trunks(rng, n) for n in rng.integers(200, size=eyes)]
        poses = np.column_stack([rng.uniform(-0.7, 0.7, (eyes, 2)), rng.normal(0, 2, eyes)])
        poses[-1] = 0.0
        forests[-1] = np.array([[-5.0, 0.0]])  # behind the last eye, which sees no trunk
        frames = camera(poses, forests, SCENE, beacon)
        assert frames.shape == (eyes, 84, 84)
        assert frames.dtype == np.uint8
        for frame, (x, y, heading), forest in zip(frames, poses, forests, strict=True):
            assert (frame == see((x, y), heading, forest, SCENE, beacon)).all()
        assert painted(frames[-1]).any() == (beacon is not None)


def test_eyes_that_see_no_trunk_at_all_see_sky_and_ground() -> None:
    frames = camera(np.zeros((3, 3)), [np.empty((0, 2))] * 3, SCENE)
    assert not any(painted(frame).any() for frame in frames)


def test_rays_of_many_eyes_stop_where_those_of_each_alone_do() -> None:
    rng = np.random.default_rng(4)
    forests, bearings = [random_trunks(rng, n) for n in (20, 0, 7)], rng.uniform(-3, 3, 50)
    alone = [raycast(forest, 0.5, bearings) for forest in forests]
    eye = np.repeat(np.arange(3), [20, 0, 7])
    order = rng.permutation(27)  # trunks come in any order
    trunks = np.concatenate(forests)[order]
    distance, facing = raycast(trunks, 0.5, bearings, eye[order], 3)
    assert (distance == np.concatenate([d for d, _ in alone])).all()
    assert (facing == np.concatenate([f for _, f in alone])).all()


# -------------------------------------------------- pictures for people


def test_the_map_shows_trunks_start_and_goal_where_they_are() -> None:
    forest = draw_map(np.array([[45.0, 10.0]]), (90, 50))
    image = draw_ways(forest, [(np.array([[0, 0], [5, 0]]), "crash", "")])
    assert forest.getpixel(((2 + 4) * 8, (25 + 4) * 8)) == (0xF2, 0xF2, 0xEA)  # a copy was drawn on
    assert image.getpixel(((45 + 4) * 8, (25 + 4 - 10) * 8)) == (0x5B, 0x5B, 0x50)
    assert image.getpixel(((45 + 4) * 8, (25 + 4 + 10) * 8)) == (0xF2, 0xF2, 0xEA)
    assert image.getpixel(((2 + 4) * 8, (25 + 4) * 8)) == RED


def bars(panel: Image.Image, actions: int = 9) -> list[tuple[tuple, int]]:
    """Colour and height in px of each action's bar, the highest action, a left turn, first."""
    pixels = np.asarray(panel.convert("RGB"))
    columns = [pixels[240:307, int(224 * (i + 0.5) / actions) + 4] for i in range(actions)]
    return [(tuple(c[-1].tolist()), int((c == c[-1]).all(1).sum())) for c in columns]


@pytest.mark.parametrize("end", [(0.0, 25.0), (90.0, 25.0), (90.0, -25.0), (45.0, 0.0)])
def test_labels_of_flights_that_end_at_one_place_are_whole_wherever_that_is(end: Point) -> None:
    chart, path = draw_map(np.empty((0, 2)), (90, 50)), np.array([end])

    def ink(way: np.ndarray, labels: list[str]) -> int:
        named = draw_ways(chart, [(way, "crash", label) for label in labels])
        bare = draw_ways(chart, [(way, "crash", "") for _ in labels])
        return int((np.asarray(named) != np.asarray(bare)).any(-1).sum())

    labels = ["random", "straight", "laser"]
    alone = sum(ink(np.array([(45.0, 0.0)]), [label]) for label in labels)
    assert ink(path, labels) == pytest.approx(alone, rel=0.02)  # a few pixels lie on a border line


def test_the_chosen_bar_is_red_and_the_tallest_is_the_best_action() -> None:
    rng, frame, chart = np.random.default_rng(5), np.zeros((84, 84), np.uint8), blank()
    for _ in range(20):
        q, action = rng.normal(50, 20, 9), int(rng.integers(9))
        colours, heights = zip(
            *reversed(bars(draw_panel(frame, chart, q, action, ()))), strict=True
        )
        assert colours == tuple(RED if a == action else GREY for a in range(9))
        assert np.argmax(heights) == q.argmax()
        share = (q - q.min()) / np.ptp(q)
        assert np.subtract(heights, min(heights)) == pytest.approx(60 * share, abs=1)


def test_values_that_are_equal_or_missing_have_flat_bars() -> None:
    frame = np.zeros((84, 84), np.uint8)
    for q in (None, np.full(9, 7.0)):
        assert len({height for _, height in bars(draw_panel(frame, blank(), q, 3, ()))}) == 1


def blank() -> Image.Image:
    """A map of no trunks and no flights."""
    return draw_map(np.empty((0, 2)), (90, 50))


def test_a_panel_shows_what_the_drone_sees_and_where_it_is() -> None:
    frame = see(EYE, 0.0, np.array([[6.0, 1.0]]), SCENE)
    panel = draw_panel(frame, blank(), None, 4, ("a line",))
    assert panel.size == PANEL
    nearest = ((np.arange(232) + 0.5) * 84 / 232).astype(int)
    assert (np.asarray(panel)[:232, :232, 0] == frame[np.ix_(nearest, nearest)]).all()
    assert (np.asarray(panel)[:232, 232:] == np.asarray(blank().resize((392, 232), 2))).all()


def test_the_film_has_a_picture_a_frame_at_its_pace(tmp_path: Path) -> None:
    trunk, q = np.array([[20.0, 0.5]]), np.arange(9.0)

    def panels() -> Iterator[Image.Image]:
        for x in range(5):
            frame = see((x, 0.0), 0.0, trunk, SCENE)
            chart = draw_ways(draw_map(trunk, (90, 50)), [(np.array([[x, 0]]), "", "")])
            yield draw_panel(frame, chart, q, x, ())

    save_film(tmp_path / "f.gif", panels(), 100)
    with Image.open(tmp_path / "f.gif") as gif:
        assert gif.n_frames == 5
        for x in range(5):
            gif.seek(x)
            colours = [colour for colour, _ in reversed(bars(gif))]  # of a palette of 64
            near = [np.abs(np.subtract(colour, RED)).max() < 8 for colour in colours]
            assert near == [a == x for a in range(9)]
            assert gif.info["duration"] == 100
        assert gif.info["loop"] == 0


def test_a_film_keeps_no_picture_in_full_colour_but_the_newest(tmp_path: Path) -> None:
    drawn: list[weakref.ref] = []

    def panels() -> Iterator[Image.Image]:
        for x in range(20):
            assert sum(old() is not None for old in drawn) <= 1
            picture = Image.new("RGB", PANEL, (10 * x, 0, 0))
            drawn.append(weakref.ref(picture))
            yield picture
            del picture

    save_film(tmp_path / "f.gif", panels(), 100)
    assert len(drawn) == 20
