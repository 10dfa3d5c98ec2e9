"""Each observation in the replay has its pose, a reflection turns it, and trainings can be cut."""

import math
from pathlib import Path

import numpy as np
import torch

from env import VecForest, World
from extras.lessons.expert import consult, plan
from extras.lessons.memory import QNetwork
from extras.lessons.place import PlaceConfig, PlaceReplay, mirror
from extras.tests.test_expert import assert_same_training, finish, little_to_fly

__all__ = ["little_to_fly"]  # a fixture of all tests here too
SMALL = {"learning_starts": 80, "replay_size": 160, "update_every": 16, "batch_size": 8}


def flown(steps: int) -> tuple[PlaceReplay, list[list[float]]]:
    """A replay of one random drone, and its true pose before each step."""
    envs, rng = VecForest(World(), 1, iter(range(100))), np.random.default_rng(0)
    consult(envs, c := PlaceConfig())
    replay, poses = PlaceReplay(c.replay_size, QNetwork(9), envs), []
    for _ in range(steps):
        s = envs.reset_done()
        x, y, psi = envs.drones[0].pose
        poses.append([math.cos(psi), math.sin(psi), 2 * x / 90 - 1, 2 * y / 50])
        s2, r, terminated, truncated, _ = envs.step(a := rng.integers(9, size=1))
        replay.add(s, a, r, s2, terminated, truncated)
    return replay, poses


def test_the_header_tells_what_the_planner_says_of_two_edges() -> None:
    bearings, nothing = np.arange(360) * (2 * np.pi / 360), np.full(360, World.laser_range)
    for pose, straight, right in (((82, 15, 0), 112.3, 112.5), ((40, 17, np.pi / 2), 4.0, 58.4)):
        scores = plan(bearings, nothing, pose, World(), PlaceConfig())
        assert [round(scores[4], 1), round(scores[0], 1)] == [straight, right]


def test_a_drawn_transition_comes_with_the_pose_in_which_its_frames_were_seen() -> None:
    replay, poses = flown(80)
    rows = np.arange(3, 75)
    batch = replay.window(rows, np.zeros(72, int), 5, 0.99)
    assert np.allclose(batch.pose, np.array(poses)[rows], atol=1e-5)


def test_a_reflected_transition_is_at_the_reflected_pose() -> None:
    replay, _ = flown(40)
    draw = replay.sample(16, 5, 0.99, np.random.default_rng(1))
    before = type(draw)(*(x.clone() for x in draw))
    after = mirror(draw, 9, np.random.default_rng(2))
    flip = torch.from_numpy(np.random.default_rng(2).random(16) < 0.5)
    sign = torch.where(flip[:, None], torch.tensor([1, -1, 1, -1]), 1)
    assert flip.any() and not flip.all()
    assert torch.equal(after.pose, before.pose * sign)
    assert torch.equal(after.scores[flip], before.scores[flip].flip(1))
    assert torch.equal(after.s[~flip], before.s[~flip])


def test_a_training_cut_and_resumed_is_uninterrupted(tmp_path: Path) -> None:
    c = PlaceConfig(**SMALL, steps=240)
    whole = finish(c, tmp_path / "whole")
    cut = finish(c, tmp_path / "cut", cuts=(72, 120, 200))
    assert_same_training(whole, cut)
    assert np.array_equal(whole.replay.poses, cut.replay.poses)
