"""looks.py: other light, other bark. How does a pilot fly where the world looks different? [DF §IV]

    python -m extras.lessons.looks train --name looks-grey
                                              grey camera, a random look in each forest
    python -m extras.lessons.looks train --camera disparity --name looks-disparity
                                              disparity camera, random errors
    python -m extras.lessons.looks eval --weights runs/looks-disparity/best.pt
    python -m extras.lessons.looks fly        four pilots in every look: results/transfer.json

A training takes about an hour, and `fly` half an hour. `eval` flies in the plain look.
figures/transfer.png, which extras/experiments/figures.py draws, shows all looks.

**The question.** A network that learns from frames learns everything that helps, and so also what
is true only in its training: that bark is darker than the sky, say. In another forest this misleads
it, although no trunk stands elsewhere. There are two remedies.

**Disparity** leaves out of the frame what must not matter. It is what a stereo camera measures: by
how many pixels a point is shifted between the left and the right picture. That depends on geometry
alone. Our frame says 510 / depth, 255 at 2 m and nearer.

In numbers: a trunk stands 8.5 m away. A grey camera sees its bark, grey level 35, through haze that
ends the view at 40 m: 90 + (35 - 90) * (1 - 8.5 / 40) = 46.7, darker than the sky's 90. With bark
of grey level 220 it is 90 + (220 - 90) * (1 - 8.5 / 40) = 192, brighter than the sky. In the frame
of disparity it is 510 / 8.5 = 60 in both forests.

A real stereo camera makes errors of its own. It must find each point of the left picture in the
right one, and a trunk of one colour shows only its two edges, so there are holes between. And it
measures whole pixels. With lenses 12 cm apart and a focal length of 320 pixels the shift is 320 *
0.12 / 8.5 = 4.5 pixels; rounded down it is 4. A pixel is 510 / (320 * 0.12) = 13 levels of our
frame, which says 52 in place of 60.

**Domain randomization** lets what must not matter vary in the training, so that nothing can be
learnt from it [Tobin 2017]. Each forest gets a random look, from ranges that include all tested
looks (for disparity all but haze). The forest seeds the look; forest and pose seed the noise. So an
episode is still determined by its seed and its actions, and an interrupted training can go on.

**What differs from expert.py**
    env.draw_frame   while `train` runs, `wear_at_random` stands in its place
The network, the loss, the planner and the loop are the same.

**What came out** in 200 forests (results/transfer.json)
    * The grey pilot crosses 87 % in the world of its training, and 0 % where bark is bright or
      striped, or at dusk. A second one, trained with random looks, crosses 70 to 83 %, and
      77 % in the plain world.
    * The disparity pilot crosses 86.5 % whatever the paint and the light, because its frames do
      not show them. With all errors of a stereo camera together it crosses 66.5 %. A fourth
      pilot, trained with random errors, crosses 86 %: we would try this one on a real drone.

Legend
    level a step of a frame's 0 to 255
    [Tobin 2017]  Domain randomization for transferring deep neural networks from simulation to the
                  real world, IROS
"""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray
from numpy.random import Generator

import deepflight
import env
from extras.lessons import recipe
from extras.lessons.expert import ExpertConfig
from render import PIXELS, SLOPES, Scene, background, draw_frame, shade

ROOT = Path(__file__).parents[2]
RESULT, FORESTS = ROOT / "results/transfer.json", range(6 * 10**9, 6 * 10**9 + 200)
METRICS = ("crossed", "crash")


@dataclass(frozen=True)
class Look:
    """What a camera makes of the same forest. Levels are those of a frame, 0 to 255."""

    scene: dict[str, Any] = field(default_factory=dict)  # fields of render.Scene: paint and air
    stripes: float = 0.0  # m, the height of a bright ring of bark, and of the dark one above it
    gain: float = 1.0  # by which light is multiplied
    vignette: float = 0.0  # the share of light that is lost in the corners
    blur: bool = False  # the mean of 3x3 pixels
    noise: float = 0.0  # levels, standard deviation, in every pixel of a grey frame
    error: float = 0.0  # the same of disparity; 4 levels are 0.6 m at 8.5 m, 2.3 m at 17 m
    holes: float = 0.0  # the share of 4x4 blocks in a trunk where the camera finds no depth
    filled: bool = False  # a hole gets the last depth to its left, and not 0
    quantum: int = 1  # levels between two depths that the camera can tell apart
    fat: int = 0  # px too wide on a trunk's right, twice that on its left: ours


PLAIN, NO_HAZE, THICK_HAZE = Look(), Look({"view": 1000.0}), Look({"view": 15.0})
LOOKS = {  # camera -> name -> look. Disparity notices only haze, because `view` hides trunks.
    "grey": {
        "plain": PLAIN,
        "bright bark": Look({"trunk_facing": 220, "trunk_grazing": 150}),
        "striped bark": Look(stripes=0.5),
        "no haze": NO_HAZE, "thick haze": THICK_HAZE,
        "bright sky": Look({"sky": 220}), "dusk": Look(gain=0.35),
        "ground dark as bark": Look({"ground": 20}), "vignette": Look(vignette=0.8),
        "blur": Look(blur=True), "sensor noise": Look(noise=12.0),
    },
    "disparity": {
        "plain": PLAIN, "no haze": NO_HAZE, "thick haze": THICK_HAZE,
        "depth noise": Look(error=4.0),
        "holes": Look(holes=0.5), "holes, filled": Look(holes=0.5, filled=True),
        "whole steps": Look(quantum=13), "shifted edges": Look(fat=1),
        "all together": Look(error=4.0, holes=0.5, filled=True, quantum=13, fat=1),
    },
}  # fmt: skip
PILOTS = {  # name -> weights; the second and the fourth are made by `train`
    "grey": ROOT / "weights/imitation.pt",
    "grey, random looks": ROOT / "runs/looks-grey/best.pt",
    "disparity": ROOT / "weights/imitation-disparity.pt",
    "disparity, random errors": ROOT / "runs/looks-disparity/best.pt",
}


# -------------------------------------------------- what a look does to a frame


def wear(look: Look, pose: Sequence[float], trunks: ndarray, scene: Scene) -> ndarray:
    """What render.draw_frame draws, in this look: (84, 84) uint8."""
    scene = replace(scene, **look.scene)
    frame = draw_frame(pose, trunks, scene)  # (84, 84)
    if look.stripes and scene.camera == "grey":
        frame = paint_rings(
            frame, draw_frame(pose, trunks, replace(scene, camera="disparity")), look, scene
        )
    change = mismatch if scene.camera == "disparity" else expose
    # The seed: the bits of pose and first trunk. Without abs, 0.0 and -0.0 would differ.
    rng = np.random.default_rng(np.abs([*pose, *trunks[0]]).view(np.uint32))
    changed = change(frame.astype(float), look, scene, rng)  # (84, 84)
    return np.clip(np.rint(changed), 0, 255).astype(np.uint8)


def paint_rings(frame: ndarray, disparity: ndarray, look: Look, scene: Scene) -> ndarray:
    """Bright rings around the trunks; frame, disparity: the same view, (84, 84) both."""
    trunk = disparity > background(replace(scene, camera="disparity"))  # (84, 84)
    depth = 255 * scene.near / np.maximum(disparity, 1)  # (84, 84) m
    height = scene.altitude + SLOPES[:, None] * depth  # (84, 84) m above the ground
    ring = trunk & (np.floor(height / look.stripes) % 2 == 0)  # (84, 84)
    return np.where(ring, shade(200, depth, depth, scene), frame)


def expose(frame: ndarray, look: Look, _scene: Scene, rng: Generator) -> ndarray:
    """Light, lens and sensor of a grey frame (84, 84)."""
    grey = frame * look.gain * (1 - look.vignette * (SLOPES**2 + SLOPES[:, None] ** 2) / 2)
    if look.blur:
        wide = np.pad(grey, 1, mode="edge")  # (86, 86)
        rows = wide[:-2] + wide[1:-1] + wide[2:]  # (84, 86)
        grey = (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9  # (84, 84)
    return grey + look.noise * rng.standard_normal(frame.shape, np.float32)


def mismatch(frame: ndarray, look: Look, scene: Scene, rng: Generator) -> ndarray:
    """What a stereo camera gets wrong in a frame of disparity (84, 84)."""
    if look.fat:  # widens trunks by fat px to the right, and by 2 * fat to the left
        padded = np.pad(frame, ((0, 0), (look.fat, 2 * look.fat)))
        shifted = [padded[:, i : i + PIXELS] for i in range(3 * look.fat + 1)]
        frame = np.maximum.reduce(shifted)  # (84, 84)
    if look.holes:
        trunk = frame > background(scene)  # (84, 84)
        inside = trunk & np.roll(trunk, 1, 1) & np.roll(trunk, -1, 1)  # (84, 84) not the two edges
        blocks = rng.random((21, 21)) < look.holes
        hole = inside & np.kron(blocks, np.ones((4, 4), bool))  # (84, 84)
        last = np.maximum.accumulate(
            np.where(hole, 0, np.arange(84)), 1
        )  # (84, 84) the last column without a hole
        filled = np.take_along_axis(frame, last, 1)  # (84, 84)
        frame = filled if look.filled else np.where(hole, 0, frame)
    frame = frame + look.error * rng.standard_normal(frame.shape, np.float32) * (frame > 0)
    return np.floor(frame / look.quantum) * look.quantum


@contextmanager
def seeing(draw: Callable[..., ndarray]) -> Iterator[None]:
    """Let every drone see what `draw` draws, a function like render.draw_frame."""
    plain, env.draw_frame = env.draw_frame, draw
    try:
        yield
    finally:
        env.draw_frame = plain


# -------------------------------------------------- train


def random_look(camera: str, rng: Generator) -> Look:
    """A look at random, from ranges that hold those of LOOKS."""

    def maybe(most: float) -> float:  # 0 in half of all looks
        return rng.integers(2) * rng.uniform(0, most)

    if camera == "disparity":
        spoilt = {"error": maybe(6), "holes": maybe(0.7), "filled": bool(rng.integers(2))}
        return Look(**spoilt, quantum=1 + round(maybe(16)), fat=int(rng.integers(2)))
    bark = int(rng.integers(256))
    paint = {"sky": int(rng.integers(20, 251)), "ground": int(rng.integers(251))}
    paint |= {"trunk_facing": bark, "trunk_grazing": int(bark * rng.uniform(0, 1))}
    paint |= {"view": float(rng.choice([rng.uniform(12, 60), 1000.0], p=[0.8, 0.2]))}
    lens = {"gain": rng.uniform(0.3, 1.2), "vignette": maybe(1), "blur": bool(rng.integers(2))}
    stripes = maybe(1.5)
    return Look(paint, **lens, noise=maybe(15), stripes=max(stripes, 0.2) if stripes else 0.0)


def wear_at_random(pose: Sequence[float], trunks: ndarray, scene: Scene) -> ndarray:
    """What a drone sees in the look of its forest: (84, 84) uint8."""
    rng = np.random.default_rng(np.abs(trunks[0]).view(np.uint32))  # the same in each step
    return wear(random_look(scene.camera, rng), pose, trunks, scene)


def train(
    c: deepflight.Config, envs: env.VecForest, rng: Generator, shaped: Callable
) -> Iterator[tuple]:
    """The loop of expert.py. While it runs, all drones see random looks, in validation too."""
    with seeing(wear_at_random):
        yield from ExpertConfig.train(c, envs, rng, shaped)


LooksConfig = recipe(
    "LooksConfig", ExpertConfig, pilot="looks", train=staticmethod(train),
    program="-m extras.lessons.looks",
)  # fmt: skip


# -------------------------------------------------- fly in every look


def fly_all() -> None:
    """Fly each pilot whose weights are there in each look of its camera; print and write."""
    report = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    for pilot, path in PILOTS.items():
        if path.exists():
            q, world, _ = deepflight.load_weights(path)
            for name, look in LOOKS[world.camera].items():
                with seeing(partial(wear, look)):
                    episodes = env.fly(deepflight.dqn_pilot(q), FORESTS, world)
                shares = {key: float(deepflight.measure(episodes)[key].mean()) for key in METRICS}
                print(f"{pilot}, {name}:", shares, flush=True)
                found = {key: deepflight.wilson(p, len(FORESTS)) for key, p in shares.items()}
                report.setdefault(pilot, {})[name] = found
    RESULT.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(fly_all() if sys.argv[1:] == ["fly"] else deepflight.main(None, LooksConfig))
