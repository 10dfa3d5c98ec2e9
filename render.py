r"""render.py: the camera. It turns a forest of upright cylinders into a grey frame of 84x84 pixels.

All trunks are upright and equally tall, so in each column of the frame the nearest one hides the
others. One ray in the ground plane finds it. A camera is 84 rays, and no 3D engine is needed.

    seen from above                              the same trunk in the frame

       left (y)                                         the middle
          |            .-'  bearing +45 deg      row 0  +-----+-----+
          |         .-'                                 | sky |     |
          |      .-'    ( )  trunk                      |  ## |     |
          |   .-'                                 41.5  |--##-+-----|  the horizon
        drone ------------------> ahead (x)             |  ##       |
              '-.                                       |   ground  |
                 '-.        bearing -45 deg      row 83 +-----------+

Where does a ray meet a trunk?

                   .-~~~-.
    camera ------ #---p---.------>   along       from the camera to p, the ray's nearest point to
                 / `. |    \                     the trunk's centre c
                |    `c     |        across      from p to c
                 \         /         half_chord  from the surface # to p
                  `-.....-'          radius      from the surface # to c

    half_chord = sqrt(radius^2 - across^2)      by Pythagoras, if abs(across) < radius
    distance   = along - half_chord             from the camera to the surface
    cosine     = half_chord / radius            of the angle of incidence, at #: 1 where the ray
                                                meets it head-on, 0 where it grazes it

One ray in numbers: a trunk of radius 0.5 m stands 10 m ahead and 0.3 m to the left. For the ray
straight ahead along = 10, across = 0.3, half_chord = 0.4, distance = 9.6 and cosine = 0.8.

A pinhole camera has two rules:
  * Column i looks to the left by a bearing with tan(bearing) = (41.5 - i) / 42. So the columns are
    equally spaced on the flat image, and not in angle.
  * Depth is how far a point is straight ahead: distance * cos(bearing). At depth z, row i shows a
    point (41.5 - i) / 42 * z metres above the camera. With distance in place of depth, a wall's
    straight top would bend.
The trunk of the example is 9.6 m away. Its top is 4 m higher than the camera, its foot 2 m lower,
so it fills the rows from 41.5 - 42 * 4 / 9.6 = 24.0 to 41.5 + 42 * 2 / 9.6 = 50.25.

The grey camera shows how bright a point is, the disparity camera how near it is, whatever its
colour and the light. So a pilot that learns from disparity in one forest should fly in forests that
look different [DF §IV].

Legend
    N, M  trunks, rays
    grey  0 is black, 255 is white
    [DF]  the Deep Flight paper; "authors' simulator": its code; "ours": a number from neither

Not in this file: textures, shadows, leaning trunks, a drone that climbs.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy import ndarray
from PIL import Image, ImageDraw

PIXELS = 84  # height and width of a frame [DF §II-A]
# (84,) the slope of column i to the left, or of row i upwards; 45 degrees to each side (ours).
SLOPES = ((PIXELS - 1) / 2 - np.arange(PIXELS)) / (PIXELS / 2)
BEARINGS = np.arctan(SLOPES)  # (84,) rad, counter-clockwise from straight ahead
COSINES = np.cos(BEARINGS)  # (84,) depth for each metre along a ray


@dataclass(frozen=True)
class Scene:
    """All that a frame depends on: sizes in m, grey levels 0 to 255."""

    trunk_radius: float = 0.5  # m, authors' simulator
    trunk_height: float = 6.0  # m, authors' simulator
    altitude: float = 2.0  # m, of the camera, authors' simulator
    view: float = 40.0  # m, how far the camera sees; ours, as all below except length
    length: float = 90.0  # m, x of the goal, which stands at y = 0 on the far edge [DF §II-A]
    beacon: bool = False  # a pole that makes the goal visible; off in the paper's world
    beacon_height: float = 20.0  # m
    beacon_radius: float = 1.0  # m
    beacon_pixels: float = 3.0  # px, its least width; the 84 show 2 * depth metres
    camera: str = "grey"  # or "disparity"
    near: float = 2.0  # m, disparity is 255 at this depth
    sky: int = 90  # this and all below: grey levels
    ground: int = 60
    trunk_facing: int = 35  # a surface seen head-on
    trunk_grazing: int = 0  # a surface seen edge-on: darker, so that a trunk looks round
    beacon_grey: int = 140  # brighter than all else


def raycast(centres: ndarray, radius: float, bearings: ndarray) -> tuple[ndarray, ndarray]:
    """Find what each ray of a camera hits first. The camera may not stand inside a trunk.

    centres (N, 2): m, how far ahead and to the left each trunk stands. radius: m. bearings (M,):
    rad. Returns the distance (M,) in m along each ray and the cosine (M,) of the angle of
    incidence; where a ray hits nothing they are inf and 0.

    >>> raycast(np.array([[5.0, 0.0]]), 0.5, np.array([0.0, 1.0]))
    (array([4.5, inf]), array([1., 0.]))
    """
    along = centres @ np.array([np.cos(bearings), np.sin(bearings)])  # (N, M) m
    across = centres @ np.array([-np.sin(bearings), np.cos(bearings)])  # (N, M) m
    hit = (along > 0) & (np.abs(across) < radius)  # (N, M) neither behind nor beside
    half_chord = np.sqrt(np.where(hit, radius**2 - across**2, 0.0))  # (N, M) m
    distance = np.where(hit, along - half_chord, np.inf)  # (N, M) m
    nearest = distance.min(0, initial=np.inf)  # (M,) m
    half_chord[distance > nearest] = 0.0  # all but the nearest trunk's, for max below
    return nearest, half_chord.max(0, initial=0.0) / radius


def shade(grey: ndarray | float, air: ndarray | float, depth: ndarray, scene: Scene) -> ndarray:
    """The value, 0 to 255, of a pixel that shows a surface of this grey level, depth m ahead.

    air: m of air before it, or 0 for the beacon, which always looks clear. The grey camera mixes
    the grey level with the sky's: the more air, the more sky, and only sky where the view ends. A
    stereo camera sees a point through two lenses, in two columns. They differ by the disparity,
    which is in proportion to 1 / depth. Ours is 255 * near / depth, at most 255.

    >>> shade(0, 0, np.array([1.0, 2.0, 4.0, np.inf]), Scene(camera="disparity"))
    array([255. , 255. , 127.5,   0. ])
    """
    if scene.camera == "disparity":
        return np.minimum(255 * scene.near / depth, 255)
    return scene.sky + (grey - scene.sky) * np.maximum(1 - air / scene.view, 0)


@cache
def background(scene: Scene) -> ndarray:
    """The column (84, 1) uint8 behind all trunks: sky and ground. The air before a point is taken
    to be its depth. A row of slope -t meets the ground at depth altitude / t."""
    depth = np.where(SLOPES < 0, scene.altitude / np.abs(SLOPES), np.inf)[:, None]  # (84, 1) m
    return shade(scene.ground, depth, depth, scene).astype(np.uint8)


def paint(frame: ndarray, depth: ndarray, height: float, value: ndarray, scene: Scene) -> ndarray:
    """Draw upright cylinders over a frame (84, 84) or a column (84, 1); returns (84, 84).
    depth (84,): m, of their surface, inf where there is none. value (84,): of their pixels."""
    foot, top = -scene.altitude / depth, (height - scene.altitude) / depth  # (84,) slopes
    inside = (SLOPES[:, None] > foot) & (SLOPES[:, None] <= top)  # (84, 84) none at inf
    return np.where(inside, value.astype(np.uint8), frame)


def draw_frame(pose: tuple, trunks: ndarray, scene: Scene) -> ndarray:
    """What a drone sees: a frame (84, 84) uint8. pose: x, y in m, heading in rad. trunks (N, 2): m.

    Like a painter it draws the background, then the pole over it, then the trunks before the pole.
    """
    frame, seen = background(scene), seen_from(pose, trunks)  # (84, 1), (N, 2) m
    ahead, left = seen.T  # (N,), (N,) m
    # Keep what may be in view: between the frame's edges at 45 degrees, and a trunk's width beyond.
    seen = seen[(ahead < scene.view) & (np.abs(left) < ahead + 2 * scene.trunk_radius)]  # (N, 2) m
    distance, cosine = raycast(seen, scene.trunk_radius, BEARINGS)  # (84,) m, (84,)
    depth = distance * COSINES  # (84,) m, straight ahead
    if scene.beacon:  # visible from any distance
        goal = seen_from(pose, np.array([[scene.length, 0.0]]))  # (1, 2) m
        radius = max(scene.beacon_radius, scene.beacon_pixels / PIXELS * goal[0, 0])  # m
        pole = raycast(goal, radius, BEARINGS)[0] * COSINES  # (84,) m, its depth
        value = shade(scene.beacon_grey, 0, pole, scene)  # (84,)
        frame = paint(frame, pole, scene.beacon_height, value, scene)
        depth = np.where(depth < pole, depth, np.inf)  # the pole hides what is behind it
    grey = scene.trunk_grazing + (scene.trunk_facing - scene.trunk_grazing) * cosine  # (84,)
    return paint(frame, depth, scene.trunk_height, shade(grey, distance, depth, scene), scene)


def seen_from(pose: tuple, points: ndarray) -> ndarray:
    """How far ahead of a drone and to its left these points lie: (N, 2) m.

    pose: x, y in m and heading in rad. points (N, 2): x, y in m.

    >>> seen_from((1.0, 0.0, 0.0), np.array([[4.0, 2.0]]))
    array([[3., 2.]])
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    # (x, y) @ this = (x cos + y sin, y cos - x sin), which is (ahead, left)
    return (points - pose[:2]) @ np.array([[cos, -sin], [sin, cos]])  # (N, 2)


# -------------------------------------------------- the film's picture: skip this at first


def draw_panel(drone: Any, path: ndarray, q: ndarray, text: str) -> Image.Image:
    """One picture of a drone, see env.py: its frame, its path (T, 2) in m on a map of the trunks,
    and what the network says of each action, q (A,), left turns on the left, the greatest blue."""
    image = Image.new("RGB", (1248, 656), "#f4f4ee")  # px, twice too large: lines become smooth
    draw = ImageDraw.Draw(image)
    image.paste(Image.fromarray(drone.observation[-1]).resize((464, 464), Image.Resampling.NEAREST))
    trunks, path = (points * (8, -8) + (496, 232) for points in (drone.trunks, path))  # px
    draw.rectangle([480, 32, 1216, 432], outline="gray", width=2)  # the forest's edges
    draw.circle((1216, 232), 24, outline="seagreen", width=3)  # the goal
    for trunk in trunks:
        draw.circle(tuple(trunk), 4, fill="gray")
    colour = {"": "royalblue", "goal": "seagreen", "far": "seagreen"}.get(drone.outcome, "crimson")
    draw.line(path.ravel().tolist(), fill=colour, width=6)
    draw.circle(tuple(path[-1]), 8, fill=colour)
    for a, value in enumerate(q):
        x, top = 8 + 50 * (len(q) - 1 - a), 608 - 120 * (value - q.min()) / max(np.ptp(q), 1e-9)
        draw.rectangle([x, top, x + 42, 612], fill="royalblue" if value == q.max() else "gray")
    draw.text((8, 618), "value of each turn, left to right", fill="black", font_size=28)
    draw.text((496, 476), text, fill="black", font_size=34, spacing=8)
    return image.reduce(2).quantize(64, Image.Quantize.FASTOCTREE)
