r"""render.py: the camera. It turns a forest of upright cylinders into a grey frame of 84x84 pixels.

Every trunk is upright, so each column of the frame is one ray in the ground plane, and no 3D engine
is needed. A camera is 84 rays.

    seen from above                              the same trunk in the frame

       left (y)                                        column 41.5
          |            .-'  bearing +45 deg      row 0  +-----+-----+
          |         .-'                                 | sky |     |
          |      .-'    ( )  trunk                      |  ## |     |
          |   .-'                                 41.5  |--##-+-----|  the horizon
        drone ------------------> ahead (x)             |  ##       |
              '-.                                       |   ground  |
                 '-.        bearing -45 deg      row 83 +-----------+

Where does a ray meet a trunk?

                   .-~~~-.
    camera ------ # --p-- `------>   along       from the camera to p, the ray's nearest point to
                 /    |    \                     the trunk's centre c
                |     c     |        across      from p to c
                 \         /         half_chord  from the surface # to p
                  `-.....-'          radius      from the surface # to c

    half_chord = sqrt(radius^2 - across^2)      by Pythagoras, if across < radius
    distance   = along - half_chord             from the camera to the surface
    cosine     = half_chord / radius            1 where the ray meets the surface at # head-on,
                                                0 where it grazes it (angle of incidence)

One ray in numbers: a trunk of radius 0.5 m stands 10 m ahead and 0.3 m to the right. For the ray
straight ahead, along = 10 and across = 0.3, so half_chord = 0.4 and the surface is 9.6 m away.

A pinhole camera has two rules:
  * Column i looks along tan(bearing) = (41.5 - i) / 42, positive to the left. The columns are
    equally spaced on the image plane, and not in angle.
  * A point h metres above the camera at depth z appears in row 41.5 - 42 * h / z. Depth is measured
    along the optical axis. With the distance along the ray instead, straight walls would look bent.
The trunk of the example is 9.6 m away. Its top is 4 m higher than the camera, its foot 2 m lower,
so it fills the rows from 41.5 - 42 * 4 / 9.6 = 24.0 to 41.5 + 42 * 2 / 9.6 = 50.25.

The disparity camera draws the same outlines, but a pixel says how near its point is: 255 at 2 m and
nearer, half of that at 4 m, 0 in the sky. Paint and light do not change it, so a pilot that learns
from disparity in one forest should fly in forests that look different [DF §IV].

Legend
    E     cameras that look at the same time, one for each drone
    N     trunks
    M     rays of each camera
    H     hits: pairs of a trunk and a ray that meet
    grey  0 is black, 255 is white
    [DF]  the Deep Flight paper; "ours" marks a number that no source gives

Not in this file: textures, shadows, leaning trunks, a drone that climbs.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy import ndarray
from PIL import Image, ImageDraw

PIXELS = 84  # height and width of a frame [DF §II-A]
CENTRE = (PIXELS - 1) / 2  # px: the optical axis meets the frame between its two middle pixels
FOCAL = PIXELS / 2  # px: half the frame spans 45 degrees (ours)
SLOPES = (CENTRE - np.arange(PIXELS)) / FOCAL  # (84,) of column i, positive left; of row i, up
BEARINGS = np.arctan(SLOPES)  # (84,) rad, counter-clockwise from straight ahead
COSINES = np.cos(BEARINGS)  # (84,) depth for each metre along a ray
ROWS = np.arange(PIXELS, dtype=np.uint8)[:, None]  # (84, 1)
CAMERAS = ("grey", "disparity")  # what a pixel may say


@dataclass(frozen=True)
class Scene:
    """All that a frame depends on: sizes in m, grey levels 0 to 255."""

    trunk_radius: float = 0.5  # m, authors' simulator
    trunk_height: float = 6.0  # m, authors' simulator
    altitude: float = 2.0  # m, of the camera, authors' simulator
    view: float = 40.0  # m, how far the camera sees; this and all below are ours
    beacon_height: float = 20.0  # m
    beacon_radius: float = 1.0  # m
    beacon_pixels: float = 3.0  # px, the beacon is never drawn narrower than this
    camera: str = "grey"  # one of CAMERAS
    near: float = 2.0  # m, disparity is 255 at this depth
    sky: int = 90  # this and all below: grey levels
    ground: int = 60
    trunk_facing: int = 35  # a surface seen head-on
    trunk_grazing: int = 0  # a surface seen edge-on: darker, so that a trunk looks round
    beacon_grey: int = 140  # brighter than all else


def raycast(
    centres: ndarray, radius: ndarray | float, bearings: ndarray,
    camera_of: ndarray | int = 0, cameras: int = 1,
) -> tuple[ndarray, ndarray]:  # fmt: skip
    """Find what each ray of each camera hits first. No camera may stand inside a trunk.

    The trunks of all cameras are in one list. centres (N, 2): how far ahead and to the left of its
    camera each trunk stands, m. camera_of (N,): which camera that is. radius: m, one, or (N,).
    bearings (M,): rad.
    Returns the distance (E, M) in m along each ray, inf where it hits nothing, and the cosine
    (E, M) of the angle of incidence, 0 where it hits nothing.

    >>> raycast(np.array([[5.0, 0.0]]), 0.5, np.array([0.0, 1.0]))
    (array([[4.5, inf]]), array([[1., 0.]]))
    """
    radius, camera_of = (np.broadcast_to(x, len(centres)) for x in (radius, camera_of))  # (N,) both
    cos, sin = np.cos(bearings), np.sin(bearings)  # (M,), (M,)
    across = np.abs(centres @ np.array([-sin, cos]))  # (N, M) m: y * cos - x * sin
    # np.nonzero finds the same cells of this table, but takes three times as long.
    hits = np.flatnonzero(across < radius[:, None])  # (H,) cells, counted row by row
    trunk, ray = np.divmod(hits, len(bearings))  # (H,), (H,) row and column of each cell
    along = centres[trunk, 0] * cos[ray] + centres[trunk, 1] * sin[ray]  # (H,) m
    front = along > 0  # (H,) the others are behind the camera
    trunk, ray = trunk[front], ray[front]  # (H,), (H,)
    half_chord = np.sqrt(radius[trunk] ** 2 - across[trunk, ray] ** 2)  # (H,) m
    distance = along[front] - half_chord  # (H,) m
    # A painter draws what is far first and what is near over it. In the same way the nearest trunk
    # of a ray is written last here, and stays.
    far_to_near = np.argsort(-distance)  # (H,)
    cell = camera_of[trunk[far_to_near]], ray[far_to_near]  # (H,), (H,)
    nearest, cosine = np.full((cameras, len(bearings)), np.inf), np.zeros((cameras, len(bearings)))
    nearest[cell] = distance[far_to_near]
    cosine[cell] = (half_chord / radius[trunk])[far_to_near]
    return nearest, cosine


def shade(grey: ndarray | float, air: ndarray | float, depth: ndarray, scene: Scene) -> ndarray:
    """The value of a pixel, 0 to 255. depth: m, of what it shows.

    air: m in front of it, or 0 for the beacon, which always looks clear. The grey camera mixes a
    grey level with the sky's: the more air, the more sky, and nothing else where the view ends. A
    stereo camera has two lenses side by side, which see a point in columns that differ by focal
    length * baseline / depth. That is the disparity; 255 * near stands for focal length * baseline.

    >>> shade(0, 0, np.array([1.0, 2.0, 4.0, np.inf]), Scene(camera="disparity"))
    array([255. , 255. , 127.5,   0. ])
    """
    if scene.camera == "disparity":
        return np.minimum(255 * scene.near / depth, 255)
    return scene.sky + (grey - scene.sky) * np.maximum(1 - air / scene.view, 0)


@cache
def background(scene: Scene) -> ndarray:
    """The column (84, 1) uint8 behind all trunks: sky above the horizon, ground below. A row of
    slope -t meets the ground at depth altitude / t."""
    depth = np.where(SLOPES < 0, scene.altitude / np.abs(SLOPES), np.inf)[:, None]  # (84, 1) m
    return shade(scene.ground, depth, depth, scene).astype(np.uint8)


def layer(
    distance: ndarray, height: float, grey: ndarray | float, air: ndarray, scene: Scene
) -> tuple[ndarray, ndarray]:
    """How cylinders look whose surface is at distance (E, 84) m, inf where there is none.

    height: m. grey, air: (E, 84), see `shade`. Returns a mask (E, 84, 84) of the pixels that they
    cover, and the value (E, 1, 84) uint8 of these pixels in each column.
    """
    depth = distance * COSINES  # (E, 84) m, along the optical axis
    value = shade(grey, air, depth, scene).astype(np.uint8)  # (E, 84)
    rows = (CENTRE - FOCAL * (h - scene.altitude) / depth for h in (height, 0.0))  # (E, 84) each
    top, foot = (np.ceil(row).clip(0, PIXELS).astype(np.uint8)[:, None] for row in rows)
    return (top <= ROWS) & (foot > ROWS), value[:, None]  # top = foot where depth is inf


def draw_frames(
    poses: ndarray, trunks: Sequence[ndarray], scene: Scene, beacon: Sequence[float] | None = None
) -> ndarray:
    """Draw what E drones see: frames (E, 84, 84) uint8.

    poses (E, 3): x, y in m and heading in rad. trunks: each drone's forest, (N, 2) in m. beacon:
    where the pole at the goal stands, or None; it is visible from any distance.
    """
    seen = seen_from(poses, np.array(trunks))  # (E, N, 2) m
    ahead, left = seen[..., 0], seen[..., 1]  # (E, N), (E, N) m
    # Keep what may be in view: between the frame's edges at 45 degrees, and a trunk's width beyond.
    keep = (ahead > 0) & (ahead < scene.view) & (np.abs(left) < ahead + 2 * scene.trunk_radius)
    camera_of, n = np.nonzero(keep)[0], len(poses)  # of each trunk that is kept
    distance, cosine = raycast(seen[keep], scene.trunk_radius, BEARINGS, camera_of, n)  # (E, 84)
    grey = scene.trunk_grazing + (scene.trunk_facing - scene.trunk_grazing) * cosine  # (E, 84)
    mask, value = layer(distance, scene.trunk_height, grey, distance, scene)
    frames = mask * value + ~mask * background(scene)  # (E, 84, 84) uint8
    if beacon is None:
        return frames
    goal = seen_from(poses, np.array([beacon]))[:, 0]  # (E, 2) m
    radius = np.maximum(scene.beacon_radius, scene.beacon_pixels / 2 / FOCAL * goal[:, 0])  # (E,) m
    pole, _ = raycast(goal, radius, BEARINGS, np.arange(n), n)  # (E, 84)
    hidden = mask & (distance < pole)[:, None]  # (E, 84, 84) by a nearer trunk
    mask, value = layer(pole, scene.beacon_height, scene.beacon_grey, np.zeros_like(pole), scene)
    return np.where(mask & ~hidden, value, frames)


def seen_from(poses: ndarray, points: ndarray) -> ndarray:
    """How far ahead of each drone and to its left its points lie: (E, N, 2) m.

    poses (E, 3): x, y in m and heading in rad. points (E, N, 2), or (N, 2) for all: x, y in m.

    >>> seen_from(np.array([[1.0, 0.0, 0.0]]), np.array([[4.0, 2.0]]))
    array([[[3., 2.]]])
    """
    x, y = np.moveaxis(points - poses[:, None, :2], -1, 0)  # (E, N), (E, N) m
    cos, sin = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])  # (E, 1), (E, 1)
    return np.stack([x * cos + y * sin, y * cos - x * sin], -1)  # (E, N, 2)


# -------------------------------------------------- the film's picture: skip this at first

PANEL = (624, 328)  # px, of a picture; it is drawn twice as large, so that lines become smooth


def draw_panel(
    frame: ndarray, trunks: ndarray, path: ndarray, outcome: str, q: ndarray, text: str
) -> Image.Image:
    """One picture: the frame (84, 84), the path (T, 2) on a map of the trunks (N, 2), both in m,
    and what the network says of each action, q (A,), left turns on the left, the greatest red."""
    image = Image.new("RGB", (2 * PANEL[0], 2 * PANEL[1]), "#f4f4ee")
    draw = ImageDraw.Draw(image)
    image.paste(Image.fromarray(frame).resize((464, 464), Image.Resampling.NEAREST))
    trunks, path = (points * (8, -8) + (496, 232) for points in (trunks, path))  # px
    draw.rectangle([480, 32, 1216, 432], outline="gray", width=2)  # the forest's edges
    draw.circle((1216, 232), 24, outline="seagreen", width=3)  # the goal
    for trunk in trunks:
        draw.circle(tuple(trunk), 4, fill="gray")
    colour = {"": "royalblue", "goal": "seagreen", "far": "seagreen"}.get(outcome, "crimson")
    draw.line(path.ravel().tolist(), fill=colour, width=6)
    draw.circle(tuple(path[-1]), 8, fill=colour)
    for a, value in enumerate(q):
        x, height = 8 + 50 * (len(q) - 1 - a), 120 * (value - q.min()) / max(np.ptp(q), 1e-9)
        colour = "crimson" if value == q.max() else "gray"
        draw.rectangle([x, 608 - height, x + 42, 612], fill=colour)
    draw.text((496, 476), text, fill="black", font_size=34, spacing=8)
    return image.resize(PANEL, Image.Resampling.BOX)


def save_film(path: Path, pictures: Iterable[Image.Image], milliseconds: int) -> None:
    """Write an endless GIF."""
    first, *rest = (picture.quantize(64, Image.Quantize.FASTOCTREE) for picture in pictures)
    first.save(path, save_all=True, append_images=rest, duration=milliseconds, loop=0)
