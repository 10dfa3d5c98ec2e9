r"""render.py: the eyes. A forest of upright cylinders becomes a grey picture of 84x84 pixels.

There is no 3D engine here. Every trunk is upright, so each column of the picture is one ray in the
ground plane. A camera is 84 rays. A laser scanner is 360 rays. One formula serves both.

    seen from above                              the same trunk in the picture

       left (y)                                        column 41.5
          |            .-'  bearing +45 deg      row 0  +-----+-----+
          |         .-'                                 | sky |     |
          |      .-'    ( )  trunk                      |  ## |     |
          |   .-'                                 41.5  |--##-+-----|  the horizon
        drone ------------------> ahead (x)             |  ##       |
              '-.                                       |   ground  |
                 '-.        bearing -45 deg      row 83 +-----------+

    The formula: where does a ray meet a trunk?

                    . - .
                  /       \         along       from the eye to p, the ray's nearest point to the
      eye ------ # --- p - |--->                trunk's centre c
                 |     |   |        across      from p to c, positive to the left (here negative)
                  \    c  /         half_chord  from the bark # to p
                    ' - '           radius      from the bark # to c

      half_chord = sqrt(radius^2 - across^2)      by Pythagoras, if abs(across) < radius
      distance   = along - half_chord             from the eye to the bark
      facing     = half_chord / radius            the cosine of the angle at #: 1 head-on, 0 grazing
                                                  (bark is drawn darker where it is small)

    One ray in numbers: a trunk of radius 0.5 m stands 10 m ahead and 0.3 m to the right. A ray
    that points straight ahead has along = 10 and across = -0.3, so half_chord = 0.4, and the
    bark is 10 - 0.4 = 9.6 m away. The trunk's top is 4 m above the eye, and its foot 2 m below. It
    fills its column from row 41.5 - 42 * 4 / 9.6 = 24.0 down to row 41.5 + 42 * 2 / 9.6 = 50.25.

The two rules of a pinhole camera:
  * Column i looks along tan(bearing) = (41.5 - i) / 42, positive to the left. Columns are equally
    spaced on the picture plane, and not in angle.
  * A point h metres above the eye at depth z shows at row 41.5 - 42 * h / z. Depth is measured
    straight ahead, along the optical axis. With the distance along the ray instead, straight walls
    would look bent.

A picture, in words: for each column, cast its ray. If it hits bark, work out the depth, and from it
the rows of the trunk's top and foot. Fill the rows between with dark grey, which fades into the
sky's grey with distance. All other rows are sky above the horizon, and ground below.

That is the grey camera. The disparity camera has the same outlines. It says of each point how near
it is, 255 * 2 / depth: 255 at 2 m and nearer, half of that at 4 m, 0 in the sky. Paint and light do
not change that. So a pilot that has learnt by it in one forest should fly in others [DF §IV].

Legend
    N  trunks
    M  rays
    E  eyes that look at the same time, one for each drone
    H  hits: pairs of a ray and a trunk that meet
    x, y       metres; in the drone's own axes x is ahead and y is left
    bearing    rad, counter-clockwise from the x axis in which the trunks are given
    grey       0 is black, 255 is white
    [DF]       the Deep Flight paper, [Mnih15] the Nature paper on DQN

Not in this file: textures, shadows, trunks that lean, a drone that climbs.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy import ndarray
from PIL import Image, ImageDraw

Point = tuple[float, float]  # x, y in m

PIXELS = 84  # height and width of a picture [DF §II-A]
CENTRE = (PIXELS - 1) / 2  # px: the optical axis meets the picture between its two middle pixels
FOCAL = PIXELS / 2  # px: half the picture spans 45 degrees (the paper is silent: ours)
SLOPES = (CENTRE - np.arange(PIXELS)) / FOCAL  # (84,) how far left column i looks, and up row i
BEARINGS = np.arctan(SLOPES)  # (84,) rad
COSINES = np.cos(BEARINGS)  # (84,) depth along the optical axis for each metre along a ray
ROWS = np.arange(PIXELS, dtype=np.uint8)[:, None]  # (84, 1)
CAMERAS = ("grey", "disparity")  # what a pixel may say


@dataclass(frozen=True)
class Scene:
    """All that a picture depends on: sizes in metres, grey levels 0 to 255."""

    trunk_radius: float = 0.5  # m, authors' simulator
    trunk_height: float = 6.0  # m, authors' simulator
    altitude: float = 2.0  # m, of the eye, authors' simulator
    view: float = 40.0  # m, how far the camera sees; this and all below are our choice
    beacon_height: float = 20.0  # m
    beacon_radius: float = 1.0  # m
    beacon_pixels: float = 3.0  # px, never drawn narrower than this
    camera: str = "grey"  # of CAMERAS: a grey level, or the disparity of a stereo camera
    near: float = 2.0  # m, disparity is 255 at this depth; the nearest ground in view is at 2.02 m
    sky: int = 90  # this and all below: grey levels
    ground: int = 60
    trunk_facing: int = 35  # bark seen head-on
    trunk_grazing: int = 0  # bark seen edge-on, darker, so that a trunk looks round
    beacon_grey: int = 140  # brighter than all else


def raycast(
    trunks: ndarray, radius: float, bearings: ndarray, eye: ndarray | None = None, eyes: int = 1
) -> tuple[ndarray, ndarray]:
    """Find what each ray hits first.

    trunks (N, 2): centres relative to the eye that looks, m. radius: m. bearings (M,): rad, the
    same for every eye. Where several eyes look, each has its own forest, and `trunks` holds all of
    them: eye (N,) says which eye looks at each trunk.
    Returns the rays of the first eye, then those of the next: distance (E * M,), m along the ray,
    inf where it hits nothing, and facing (E * M,), 0 where it hits nothing.

    >>> raycast(np.array([[5.0, 0.0]]), 0.5, np.array([0.0, 1.0]))
    (array([4.5, inf]), array([1., 0.]))
    """
    cos, sin, rays = np.cos(bearings), np.sin(bearings), len(bearings)
    along = trunks @ np.array([cos, sin])  # (N, M) m: x * cos + y * sin
    across = trunks @ np.array([-sin, cos])  # (N, M) m: y * cos - x * sin
    # flatnonzero numbers the cells of the table (N, M) row by row, so with M = 84 its cell 700 is
    # trunk 700 // 84 = 8 and ray 700 % 84 = 28. The rays of several eyes stand end to end. If eye 1
    # looks at trunk 8, that ray is number 1 * 84 + 28 = 112 of all: its place.
    meet = np.flatnonzero(np.abs(across) < radius)  # (H,) the pairs that meet
    half_chord = np.sqrt(radius**2 - across.ravel()[meet] ** 2)  # (H,) m
    distance = along.ravel()[meet] - half_chord  # (H,) m; the trunk is behind if below 0
    trunk, ray = meet // rays, meet % rays  # (H,), (H,)
    place = ray if eye is None else eye[trunk] * rays + ray  # (H,)
    first, facing = np.full(eyes * rays, np.inf), np.zeros(eyes * rays)  # (E * M,), (E * M,)
    # A ray may hit several trunks. np.minimum.at then keeps the least of all its distances.
    np.minimum.at(first, place, np.where(distance > 0, distance, np.inf))
    nearest = distance == first[place]  # (H,) the hits that are their ray's first
    facing[place[nearest]] = half_chord[nearest] / radius
    return first, facing


def fade(grey: ndarray, distance: ndarray, scene: Scene) -> ndarray:
    """Mix a grey level with the sky's. The share of the sky grows with distance, to 1 where the
    view ends."""
    return scene.sky + (grey - scene.sky) * np.maximum(1 - distance / scene.view, 0)


@cache
def backdrop(scene: Scene) -> ndarray:
    """What stands behind all trunks, as one column (84, 1) uint8: sky above the horizon, and below
    it ground that fades towards the sky. The disparity camera sees how near both are.

    A row below the horizon, of slope -t, sees the ground at depth altitude / t.
    """
    depth = np.where(SLOPES < 0, scene.altitude / np.abs(SLOPES), np.inf)  # (84,) m
    if scene.camera == "disparity":
        return disparity(depth, scene)[:, None]
    return fade(np.float64(scene.ground), depth, scene).astype(np.uint8)[:, None]


def along_axis(distance: ndarray) -> ndarray:
    """The depth of what rays meet: (E * 84,) m, from the distance along each ray (E * 84,) m."""
    return (distance.reshape(-1, PIXELS) * COSINES).ravel()


def disparity(depth: ndarray, scene: Scene) -> ndarray:
    """What a stereo camera says of depths in m: 255 at `near`, half of that at twice the depth.

    Two cameras side by side see a point in columns that differ by focal length * baseline / depth.
    This difference is the disparity. It knows no colour and no light [DF §IV].

    >>> disparity(np.array([1.0, 2.0, 4.0, np.inf]), Scene())
    array([255, 255, 127,   0], dtype=uint8)
    """
    return np.minimum(255 * scene.near / depth, 255).astype(np.uint8)


def silhouette(depth: ndarray, height: float, scene: Scene) -> ndarray:
    """Pixels (84, E * 84) bool that walls of this height cover, at depth (E * 84,) m."""
    above = np.array([[height - scene.altitude], [-scene.altitude]])  # (2, 1) m, top and foot
    # A ray that hits nothing has depth inf. Top and foot are then both 42, and nothing is between.
    rows = np.ceil(CENTRE - FOCAL * above / depth)  # (2, E * 84)
    top, end = np.minimum(np.maximum(rows, 0), PIXELS).astype(np.uint8)  # (E * 84,) each
    return (top <= ROWS) & (end > ROWS)


def camera(
    poses: ndarray, trunks: Sequence[ndarray], scene: Scene, beacon: Point | None = None
) -> ndarray:
    """Draw what E drones see, all at once: frames (E, 84, 84) uint8.

    poses (E, 3): x, y in m and heading in rad. trunks: for each drone its forest, (N, 2) in m.
    beacon: where the goal's pole stands, or None where there is none; it shows from any distance.
    The E pictures are drawn side by side, as one picture of E * 84 columns, and cut at the end.
    """
    eyes = len(poses)
    eye = np.repeat(np.arange(eyes), [len(forest) for forest in trunks])  # (N,) who looks at it
    body = np.concatenate([seen_from(*pair) for pair in zip(poses, trunks, strict=True)])  # (N, 2)
    ahead, left = body.T  # (N,), (N,) m, of every trunk, for the drone that looks at it
    # Keep what may be in the picture: ahead, in view, and between its two edges at 45 degrees, with
    # two radii to spare because a trunk is wide.
    near = (ahead > 0) & (ahead < scene.view) & (np.abs(left) < ahead + 2 * scene.trunk_radius)
    distance, facing = raycast(
        body[near], scene.trunk_radius, BEARINGS, eye[near], eyes
    )  # (E * 84,)
    depth, stereo = along_axis(distance), scene.camera == "disparity"  # (E * 84,) m
    bark = scene.trunk_grazing + (scene.trunk_facing - scene.trunk_grazing) * facing  # (E * 84,)
    grey = fade(bark, distance, scene).astype(np.uint8)  # (E * 84,)
    value = disparity(depth, scene) if stereo else grey  # (E * 84,) of bark pixels
    trunk = silhouette(depth, scene.trunk_height, scene)  # (84, E * 84)
    frames = trunk * value + ~trunk * backdrop(scene)  # (84, E * 84) uint8: bark, or what is behind
    if beacon is not None:
        goal = np.concatenate([seen_from(pose, np.array([beacon])) for pose in poses])  # (E, 2) m
        to_pole = pole_distance(goal, scene)  # (E * 84,) m
        pole = silhouette(along_axis(to_pole), scene.beacon_height, scene)  # (84, E * 84)
        hidden = trunk & (distance < to_pole)  # (84, E * 84) by a nearer trunk
        value = disparity(along_axis(to_pole), scene) if stereo else scene.beacon_grey
        np.copyto(frames, value, where=pole & ~hidden)
    frames = frames.reshape(PIXELS, eyes, PIXELS)  # (84, E, 84) row, eye, column
    return np.ascontiguousarray(frames.swapaxes(0, 1))  # (E, 84, 84)


def seen_from(pose: ndarray, points: ndarray) -> ndarray:
    """How far ahead and to the left of a drone these points lie: (N, 2) m.

    pose (3,): x, y in m and heading in rad. points (N, 2): x, y in m.

    >>> seen_from(np.array([1.0, 0.0, 0.0]), np.array([[4.0, 2.0]]))
    array([[3., 2.]])
    """
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    # (x, y) @ this = (x cos + y sin, y cos - x sin), which is (ahead, left)
    return (points - pose[:2]) @ np.array([[cos, -sin], [sin, cos]])  # (N, 2)


def pole_distance(goal: ndarray, scene: Scene) -> ndarray:
    """How far away every column's ray meets the goal's pole: (E * 84,) m, inf where it does not.

    goal (E, 2): how far ahead and to the left of each eye the pole stands, m. raycast knows one
    radius only. But a pole that is twice as thick as a trunk, and twice as far away, looks like it.
    So let scale = pole's radius / trunk's radius. Cast a trunk at 1 / scale of the pole's distance,
    and multiply the distance that comes out by scale.
    """
    least = scene.beacon_pixels / 2 / FOCAL * goal[:, 0]  # (E,) m, the least radius to draw
    scale = np.maximum(scene.beacon_radius, least) / scene.trunk_radius  # (E,)
    near, eye = goal / scale[:, None], np.arange(len(goal))  # (E, 2) m, (E,)
    distance, _ = raycast(near, scene.trunk_radius, BEARINGS, eye, len(goal))  # (E * 84,) m
    return distance * np.repeat(scale, PIXELS)


# -------------------------------------------------- pictures for people: skip this at first

SCALE = 8  # px a metre on the map
MARGIN = 4.0  # m around the forest
PANEL = (624, 328)  # px, a picture of the film
COLOURS = {"crash": "#d62728", "goal": "#2ca02c", "far": "#17a2b8", "": "#1f77b4"}  # else orange

ENDS = {
    "": "", "crash": "crashed into a trunk", "goal": "arrived at the goal", "time": "out of time",
    "far": "crossed: left by the far edge", "side": "left by a side", "back": "left by the back",
}  # fmt: skip


def draw_map(trunks: ndarray, size: Point, title: str = "") -> Image.Image:
    """Draw a forest from above, x to the right and y up.

    trunks (N, 2): centres in m. size: the forest's length and width in m.
    """
    (length, width), pixels = size, [int(metres + 2 * MARGIN) * SCALE for metres in size]
    image = Image.new("RGB", tuple(pixels), "white")
    draw = ImageDraw.Draw(image)
    corners = pixel(image, 0, width / 2), pixel(image, length, -width / 2)
    draw.rectangle(corners, fill="#f2f2ea")
    for x, y in trunks:
        disc(image, x, y, Scene.trunk_radius, "#5b5b50")
    disc(image, 0, 0, 0.8, "#1f77b4")
    disc(image, length, 0, 1.6, "#2ca02c")
    draw.text((8, 4), title, fill="black", font_size=18)
    return image


def draw_ways(image: Image.Image, ways: Iterable[tuple[ndarray, str, str]]) -> Image.Image:
    """Draw flights onto a copy of a map: path (T, 2) in m, how it ended or "", label, each."""
    image, labels = image.copy(), []
    draw = ImageDraw.Draw(image)
    for path, ended, label in ways:
        colour = COLOURS.get(ended, "#ff7f0e")
        draw.line([pixel(image, x, y) for x, y in path], fill=colour, width=3)
        disc(image, *path[-1], 0.7, colour)
        x, y = pixel(image, *path[-1])
        step = 18 if y < image.height / 2 else -18  # px: towards the middle until there is room
        while any(abs(x - u) < 110 and abs(y + step - v) < 18 for u, v in labels):
            y += step
        labels.append((x, y + step))
        side = "rm" if x > 0.8 * image.width else "lm"
        draw.text(labels[-1], f" {label} ", fill=colour, font_size=18, anchor=side)
    return image


def pixel(image: Image.Image, x: float, y: float) -> Point:
    """Where a place in m stands on a map."""
    return (x + MARGIN) * SCALE, image.height / 2 - y * SCALE


def disc(image: Image.Image, x: float, y: float, r: float, colour: str) -> None:
    """Draw a filled circle, all in m."""
    box = [*pixel(image, x - r, y + r), *pixel(image, x + r, y - r)]
    ImageDraw.Draw(image).ellipse(box, fill=colour)


def draw_panel(
    frame: ndarray, chart: Image.Image, q: ndarray | None, action: int, lines: Sequence[str]
) -> Image.Image:
    """One picture of a film: what the drone sees, where it is, what it thinks, how it fares.

    frame (84, 84). chart: a map. q (A,): the values of the actions, or None. action: the chosen
    one, in red. The sharpest left turn stands leftmost, and the best action is the tallest bar.
    """
    image, actions = Image.new("RGB", PANEL, "white"), 9 if q is None else len(q)
    draw = ImageDraw.Draw(image)
    image.paste(Image.fromarray(frame).resize((232, 232), Image.Resampling.NEAREST))
    image.paste(chart.resize((392, 232), Image.Resampling.BILINEAR), (232, 0))
    heights = np.zeros(actions) if q is None else (q - q.min()) / max(np.ptp(q), 1e-9)  # (A,) 0..1
    for a, height in enumerate(heights):
        x, colour = 224 * (1 - (a + 1) / actions) + 4, "#d62728" if a == action else "#9a9a90"
        draw.rectangle([x, 304 - 60 * height, x + 224 / actions - 4, 306], fill=colour)
    draw.text((4, 310), "left    what each turn is worth    right", fill="black", font_size=13)
    draw.text((248, 242), "\n".join(lines), fill="black", font_size=19, spacing=8)
    return image


def save_film(file: Path | BinaryIO, pictures: Iterator[Image.Image], milliseconds: int) -> None:
    """Write an endless GIF, picture by picture as they come. Its comment says who wrote it."""
    small = (picture.quantize(64, Image.Quantize.FASTOCTREE) for picture in pictures)
    more = {"append_images": small, "duration": milliseconds, "loop": 0, "comment": b"Deep Flight"}
    next(small).save(file, "GIF", save_all=True, **more)
