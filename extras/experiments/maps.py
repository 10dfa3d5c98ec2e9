"""Draw a forest from above, and the ways that drones took through it."""

from collections.abc import Iterable

from numpy import ndarray
from PIL import Image, ImageDraw

from render import Scene

SCALE = 8  # px a metre
MARGIN = 4.0  # m around the forest
COLOURS = {"": "#444444", "crash": "#d55e00", "goal": "#009e73", "far": "#0072b2"}  # by the end:
COLOURS |= {"side": "#e69f00", "back": "#cc79a7", "time": "#56b4e9"}  # Okabe and Ito's palette
HOLLOW = ("side", "back", "time")  # their dots are rings, for those who see colours alike
SEEDS = ("#0072b2", "#e69f00", "#009e73")  # of the same palette


def draw_map(trunks: ndarray, size: tuple[float, float], title: str = "") -> Image.Image:
    """Draw a forest, x to the right and y up.

    trunks (N, 2): centres in m. size: the forest's length and width in m.
    """
    (length, width), pixels = size, [int(metres + 2 * MARGIN) * SCALE for metres in size]
    image = Image.new("RGB", tuple(pixels), "white")
    draw = ImageDraw.Draw(image)
    corners = pixel(image, 0, width / 2), pixel(image, length, -width / 2)
    draw.rectangle(corners, fill="#f2f2ea")
    for x, y in trunks:
        disc(image, x, y, Scene.trunk_radius, "#5b5b50")
    disc(image, 0, 0, 0.8, "#444444")
    disc(image, length, 0, 1.6, "#009e73")
    draw.text((8, 4), title, fill="black", font_size=18)
    return image


def draw_ways(image: Image.Image, ways: Iterable[tuple[ndarray, str, str]]) -> Image.Image:
    """Draw ways onto a copy of a map; each is a path (T, 2) in m, an outcome or "", a label."""
    image, labels = image.copy(), []
    draw = ImageDraw.Draw(image)
    for path, outcome, label in ways:
        colour = COLOURS[outcome]
        draw.line([pixel(image, x, y) for x, y in path], fill=colour, width=3)
        disc(image, *path[-1], 0.8, colour)
        disc(image, *path[-1], 0.45, "white" if outcome in HOLLOW else colour)
        x, y = pixel(image, *path[-1])
        step = 18 if y < image.height / 2 else -18  # px: towards the middle until there is room
        while any(abs(x - u) < 110 and abs(y + step - v) < 18 for u, v in labels):
            y += step
        labels.append((x, y + step))
        side = "rm" if x > 0.8 * image.width else "lm"
        draw.text(labels[-1], f" {label} ", fill=colour, font_size=18, anchor=side)
    return image


def pixel(image: Image.Image, x: float, y: float) -> tuple[float, float]:
    """Where a place in m stands on a map."""
    return (x + MARGIN) * SCALE, image.height / 2 - y * SCALE


def disc(image: Image.Image, x: float, y: float, r: float, colour: str) -> None:
    """Draw a filled circle, all in m."""
    box = [*pixel(image, x - r, y + r), *pixel(image, x + r, y - r)]
    ImageDraw.Draw(image).ellipse(box, fill=colour)
