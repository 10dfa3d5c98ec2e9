"""Does the forest show which way one faces? Asked of a network that is told the answer.

    .venv/bin/python -m extras.experiments.compass        # a quarter of an hour

The pilot's network, from scratch, looks at four frames from random places and headings in the
paper's world, flown straight, and learns by regression the unit vector of its heading and that of
twice its heading, which turns with the rows of trunks and does not tell one way along them from the
other. What it cannot learn so, told the truth 640,000 times, a pilot that sees four frames will
hardly learn from rewards. Asked in forests it has not seen, in the middle (15 m or more from
every edge) and at the edges (10 m or less from one, and heading for it): how far off it is, and
which edge it takes the edge for.

And what a compass is worth: how many episodes cross by the laser pilot's plan if it takes the
middle of the forest for its place, and for its heading either 0, whichever way it has come to face;
or its true heading; or its angle to the rows, whichever way along them is nearer. Writes
results/compass.json.
"""

import json
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from deepflight import TRAIN_END, Config, measure
from dqn import QNetwork, linear_schedule
from env import STACK, VecForest, World, fly, plant
from extras.lessons.expert import plan, scan
from render import draw_frames

ROOT = Path(__file__).parents[2]
WORLD = World()
BATCH, BATCHES, ASKED, EPISODES = 64, 10_000, 4_000, 500
FIRST = 2 * 10**9  # no training or validation plants these forests


def somewhere(seed: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Four frames (4, 84, 84) of a straight way through a forest, and where it ends (3,): x, y
    in m, heading in rad."""
    trunks, size = plant(seed, WORLD), np.array([WORLD.length, WORLD.width])
    while True:
        at = rng.random(2) * size - (0, WORLD.width / 2)  # m
        heading = rng.uniform(-np.pi, np.pi)  # rad
        stride = WORLD.speed * WORLD.dt * np.array([np.cos(heading), np.sin(heading)])  # m
        way = at - np.arange(STACK)[::-1, None] * stride  # (4, 2) m
        gaps = np.hypot(*(trunks[:, None] - way).T)  # (4, N) m
        if gaps.min() > WORLD.trunk_radius + WORLD.d_crash:
            poses = np.column_stack([way, np.full(STACK, heading)])  # (4, 3)
            return draw_frames(poses, [trunks] * STACK, WORLD), np.array([*at, heading])


def answer(heading: np.ndarray) -> np.ndarray:
    """What the network is to say of headings (B,) rad: (B, 4)."""
    return np.stack([f(k * heading) for k in (1, 2) for f in (np.cos, np.sin)], 1)


def off(said: np.ndarray, heading: np.ndarray, fold: int) -> float:
    """The median error in degrees of unit vectors said (B, 2) of fold times the heading (B,)."""
    error = np.arctan2(said[:, 1], said[:, 0]) - fold * heading  # (B,) rad
    return float(np.degrees(np.median(np.abs(np.angle(np.exp(1j * error))) / fold)))


def edge(heading: np.ndarray) -> np.ndarray:
    """The edge that lies that way (B,): 0 far, 1 a side, 2 back."""
    return np.abs(np.round(2 * heading / np.pi)).astype(int)


def learn(rng: np.random.Generator) -> QNetwork:
    """Tell a network the truth, 64 times a batch."""
    q = QNetwork(4)
    optimizer = torch.optim.Adam(q.parameters())
    for i in range(BATCHES):
        places = [somewhere(int(rng.integers(TRAIN_END)), rng) for _ in range(BATCH)]
        s, pose = map(np.stack, zip(*places, strict=True))  # (B, 4, 84, 84), (B, 3)
        y = torch.from_numpy(answer(pose[:, 2])).float()  # (B, 4)
        loss = F.mse_loss(q(torch.from_numpy(s)), y)
        optimizer.param_groups[0]["lr"] = linear_schedule(i, 5e-4, 0.0, BATCHES)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if i % 500 == 0:
            print(f"batch {i:,} of {BATCHES:,}: loss {loss.item():.3f}", flush=True)
    return q


def crossed(fold: int) -> float:
    """The share in % of EPISODES by the laser's scan that cross. fold: 0 straight on, 1 by
    compass, 2 along the rows whichever way is nearer."""

    c = Config(forward_reward=0.0, far_bonus=0.0)

    def pilot(_s: np.ndarray, envs: VecForest) -> list[int]:
        actions = []
        for drone in envs.active:
            heading = np.angle(np.exp(1j * fold * drone.pose[2])) / max(fold, 1)  # rad
            pose = (WORLD.length / 2, 0.0, heading)
            actions.append(int(plan(*scan(drone), pose, WORLD, c).argmax()))
        return actions

    episodes = fly(pilot, range(FIRST, FIRST + EPISODES), WORLD, blind=True)
    return float(100 * measure(episodes)["crossed"].mean())


def ask(q: QNetwork, rng: np.random.Generator) -> dict[str, float]:
    """What the network says in forests it has not seen."""
    places = [somewhere(FIRST + i, rng) for i in range(ASKED)]
    s, pose = map(np.stack, zip(*places, strict=True))  # (B, 4, 84, 84), (B, 3)
    with torch.no_grad():
        said = np.concatenate([q(torch.from_numpy(x)) for x in np.split(s, 40)])  # (B, 4)
    x, y, heading = pose.T  # (B,) each
    to = np.stack([WORLD.length - x, WORLD.width / 2 - np.abs(y), x], 1)  # (B, 3) m to each edge
    middle = to.min(1) > 15  # (B,)
    faced = edge(heading)  # (B,)
    outward = (faced != 1) | (np.sin(heading) * y > 0)  # (B,) not across to the other side
    at_edge = outward & (to[np.arange(ASKED), faced] < 10)  # (B,)
    taken = edge(np.arctan2(said[:, 1], said[:, 0]))  # (B,)
    report = {
        "heading in the middle, degrees off": off(said[middle, :2], heading[middle], 1),
        "rows in the middle, degrees off": off(said[middle, 2:], heading[middle], 2),
    }
    for i, name in enumerate(("the far edge", "a side", "the back")):
        shown = taken[at_edge & (faced == i)]
        for j, other in enumerate(("far", "side", "back")):
            report[f"{name} taken for {other}, %"] = float(100 * np.mean(shown == j))
    return report


def main() -> None:
    """Tell, ask, fly, write, print."""
    rng = np.random.default_rng(0)
    torch.manual_seed(0)
    torch.set_num_threads(1)
    report = ask(learn(rng), rng)
    for fold, name in enumerate(("straight on", "by compass", "along the rows")):
        report[f"the laser pilot, {name}: crossed, %"] = crossed(fold)
    (ROOT / "results/compass.json").write_text(json.dumps(report, indent=1) + "\n")
    print("\n".join(f"{name}: {value:.1f}" for name, value in report.items()))


if __name__ == "__main__":
    main()
