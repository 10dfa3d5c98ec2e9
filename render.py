"""render.py: the eyes. A forest of cylinders becomes an 84x84 grey picture, a laser scan, a map.

There is no 3D engine here. In a forest of upright cylinders every picture column is one ray in the
plane, so a camera is 84 rays, a laser scanner is 360 rays, and one closed formula serves both.

    seen from above                              the same trunk in the picture

       left (y)                                        column 41.5
          |            .-'  bearing +45 deg      row 0  +-----+-----+
          |         .-'                                 | sky |     |
          |      .-'    ( )  trunk                      |  ## |     |
          |   .-'                                 41.5  |--##-+-----|  the horizon
        drone ------------------> ahead (x)             |  ##       |
              '-.                                       |   ground  |
                 '-.        bearing -45 deg      row 83 +-----------+

    column i looks along tan(bearing) = (41.5 - i) / 42, positive to the left: a pinhole camera's
    columns are equally spaced on the picture plane, not in angle.
    A thing h metres above the eye at depth z shows at row 41.5 - 42 * h / z, where z is measured
    along the optical axis; the distance along the ray would bend straight walls.

Legend: N trunks, M rays; metres, radians, grey levels 0 (black) to 255 (white).
[DF] is the Deep Flight paper, [Mnih15] the Nature paper on DQN.
Not in this file: textures, shadows, trunks that lean, a drone that climbs.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy import ndarray
from PIL import Image, ImageDraw

Point = tuple[float, float]  # x, y

PIXELS = 84  # height and width of a frame [DF §II-A]
CENTRE = (PIXELS - 1) / 2  # the optical axis meets the picture between the two middle pixels
FOCAL = PIXELS / 2  # px: half the picture spans 45 degrees (the paper is silent: ours)
SLOPES = (CENTRE - np.arange(PIXELS)) / FOCAL  # (84,) tangents: left to right, and top to bottom
BEARINGS = np.arctan(SLOPES)  # (84,) rad


@dataclass(frozen=True)
class Scene:
    """All that a picture depends on: sizes in metres, grey levels 0 to 255."""

    trunk_radius: float = 0.5  # m, authors' simulator
    trunk_height: float = 6.0  # m, authors' simulator
    altitude: float = 2.0  # m, of the eye, authors' simulator
    view: float = 40.0  # m, how far the camera sees: ours, as all below
    beacon_height: float = 20.0  # m
    beacon_radius: float = 1.0  # m
    beacon_pixels: float = 3.0  # px, never drawn narrower than this
    sky: int = 90
    ground: int = 60
    trunk_facing: int = 35  # bark seen head-on
    trunk_grazing: int = 0  # bark seen edge-on
    beacon_grey: int = 140  # clear, but no more: a white pole is shunned like bark


def raycast(trunks: ndarray, radius: float, bearings: ndarray) -> tuple[ndarray, ndarray]:
    """Find what each ray from the origin hits first.

    trunks (N, 2): centres relative to the eye, m. bearings (M,): rad, in the same axes.
    Returns distance (M,), m along the ray, inf where it hits nothing, and facing (M,), the cosine
    of the angle between the ray and the surface's normal: 1 head-on, 0 grazing.

    >>> raycast(np.array([[5.0, 0.0]]), 0.5, np.array([0.0, 1.0]))
    (array([4.5, inf]), array([1., 0.]))
    """
    if not len(trunks):
        return np.full(len(bearings), np.inf), np.zeros(len(bearings))
    cos, sin = np.cos(bearings), np.sin(bearings)
    # How far a ray flies until it passes a centre, and by how much it passes it: (N, M) each.
    along, across = trunks @ np.array([[cos, sin], [-sin, cos]])
    with np.errstate(invalid="ignore"):
        half_chord = np.sqrt(radius**2 - across**2)  # (N, M) nan: the ray misses
    distance = along - half_chord  # (N, M) negative: the trunk is behind
    distance[~(distance > 0)] = np.inf
    nearest, rays = distance.argmin(0), np.arange(len(bearings))  # (M,)
    hit = distance[nearest, rays]  # (M,)
    return hit, np.where(hit < np.inf, half_chord[nearest, rays] / radius, 0.0)


def fade(grey: ndarray, distance: ndarray, scene: Scene) -> ndarray:
    """Mix a grey level with the sky's, the more the farther: at the end of the view all is haze."""
    return scene.sky + (grey - scene.sky) * np.maximum(1 - distance / scene.view, 0)


@cache
def backdrop(scene: Scene) -> ndarray:
    """Sky above the horizon, ground that brightens towards it, as one column (84, 1) uint8."""
    depth = np.where(SLOPES < 0, scene.altitude / np.abs(SLOPES), np.inf)  # (84,) m
    return fade(np.float64(scene.ground), depth, scene).astype(np.uint8)[:, None]


def silhouette(distance: ndarray, height: float, scene: Scene) -> ndarray:
    """Pixels (84, 84) bool covered by walls of this height that stand at distance (84,) m."""
    depth = distance * np.cos(BEARINGS)  # (84,) m along the optical axis
    rows = SLOPES[:, None]  # (84, 1)
    return (rows < (height - scene.altitude) / depth) & (rows > -scene.altitude / depth)


def camera(
    eye: Point, heading: float, trunks: ndarray, scene: Scene, beacon: Point | None = None
) -> ndarray:
    """Draw what the drone sees: a frame (84, 84) uint8.

    eye: x, y in m. heading: rad, counter-clockwise from x. trunks (N, 2): centres in m.
    beacon: where the goal's pole stands, or None where there is none; it shows from any distance.
    """
    cos, sin = math.cos(heading), math.sin(heading)
    to_body = np.array([[cos, -sin], [sin, cos]])  # (2, 2) x, y -> ahead, left
    body = (trunks - eye) @ to_body  # (N, 2)
    ahead, left = body.T
    near = (ahead > 0) & (ahead < scene.view) & (np.abs(left) < ahead + 2 * scene.trunk_radius)
    distance, facing = raycast(body[near], scene.trunk_radius, BEARINGS)  # (84,), (84,)
    bark = scene.trunk_grazing + (scene.trunk_facing - scene.trunk_grazing) * facing
    grey = fade(bark, distance, scene).astype(np.uint8)  # (84,)
    trunk = silhouette(distance, scene.trunk_height, scene)  # (84, 84)
    frame = np.where(trunk, grey, backdrop(scene))  # (84, 84)
    if beacon is None:
        return frame
    goal = (np.array([beacon]) - eye) @ to_body  # (1, 2)
    radius = max(scene.beacon_radius, scene.beacon_pixels / 2 / FOCAL * goal[0, 0])
    pole_distance, _ = raycast(goal, radius, BEARINGS)  # (84,)
    pole = silhouette(pole_distance, scene.beacon_height, scene)  # (84, 84)
    frame[pole & ~(trunk & (distance < pole_distance))] = scene.beacon_grey
    return frame


# -------------------------------------------------- pictures for people, not for the network

SCALE = 8  # px a metre on the map
MARGIN = 4.0  # m around the forest
COLOURS = {"crash": "#d62728", "goal": "#2ca02c", "far": "#17a2b8", "": "#1f77b4"}  # else orange


def draw_map(
    trunks: ndarray, size: Point, flights: Iterable[tuple[ndarray, str, str]], title: str = ""
) -> Image.Image:
    """Draw a forest from above, x to the right and y up.

    trunks (N, 2): centres in m. size: the forest's length and width in m.
    flights: (path (T, 2) in m, how it ended or "" in the air, label) each, coloured by its end.
    """
    length, width = size

    def pixel(x: float, y: float) -> Point:
        return (x + MARGIN) * SCALE, (width / 2 + MARGIN - y) * SCALE

    def disc(x: float, y: float, r: float, colour: str) -> None:
        draw.ellipse([*pixel(x - r, y + r), *pixel(x + r, y - r)], fill=colour)

    image = Image.new("RGB", tuple(int(m + 2 * MARGIN) * SCALE for m in size), "white")
    draw = ImageDraw.Draw(image)
    draw.rectangle([*pixel(0, width / 2), *pixel(length, -width / 2)], fill="#f2f2ea")
    for x, y in trunks:
        disc(x, y, Scene.trunk_radius, "#5b5b50")
    disc(0, 0, 0.8, "#1f77b4")
    disc(length, 0, 1.6, "#2ca02c")
    for i, (path, ended, label) in enumerate(flights):
        colour = COLOURS.get(ended, "#ff7f0e")
        draw.line([pixel(x, y) for x, y in path], fill=colour, width=3)
        disc(*path[-1], 0.7, colour)
        at, side = pixel(path[-1][0], path[-1][1] + 3 - 2 * i), "rm" if path[-1][0] > 75 else "lm"
        draw.text(at, f" {label} ", fill=colour, font_size=18, anchor=side)
    draw.text((8, 4), title, fill="black", font_size=18)
    return image


def save_film(file: Path, frames: Iterable, maps: Iterable, milliseconds: int) -> None:
    """Write an endless GIF: the camera's frames (T of (84, 84)) beside T maps at half their size.

    Its last picture stays for two seconds.
    """
    pictures = []
    for frame, chart in zip(frames, maps, strict=True):
        width, height = chart.width // 2, chart.height // 2
        both = Image.new("RGB", (height + width, height))
        both.paste(Image.fromarray(frame).resize((height, height), Image.Resampling.NEAREST))
        both.paste(chart.resize((width, height), Image.Resampling.BILINEAR), (height, 0))
        pictures.append(both.quantize(256, dither=Image.Dither.NONE))
    times = [milliseconds] * (len(pictures) - 1) + [2000]
    pictures[0].save(file, save_all=True, append_images=pictures[1:], duration=times, loop=0)
