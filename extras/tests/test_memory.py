"""Dead reckoning against the drone's true pose, and trainings that carry it, cut and resumed."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from env import Drone, VecForest, World
from extras.lessons.memory import MemoryConfig, QNetwork, Rollout, odometry
from extras.tests.test_expert import assert_same_training, finish, little_to_fly

__all__ = ["little_to_fly"]  # a fixture of all tests here too
SMALL = {"num_envs": 8, "rollout": 4, "batch_size": 16}
WORLD = World()


def true_pose(drone: Drone) -> list[float]:
    """What odometry should say of it."""
    x, y, heading = drone.pose
    return [math.cos(heading), math.sin(heading), 2 * x / 90 - 1, 2 * y / 50]


def test_dead_reckoning_without_drift_is_the_true_pose() -> None:
    drone, rng = Drone(WORLD), np.random.default_rng(0)
    for seed in range(5):
        drone.reset(seed)
        while not drone.outcome:
            assert odometry(drone.actions, WORLD) == pytest.approx(true_pose(drone), abs=1e-5)
            drone.step(int(rng.integers(9)))


def test_a_drift_of_ten_degrees_a_minute_by_hand() -> None:
    c, s, x, y = odometry([4] * 180, WORLD, bias=math.radians(10) / 60)  # 18 s straight ahead
    assert math.degrees(math.atan2(s, c)) == pytest.approx(3.0, abs=1e-4)
    assert 25 * y == pytest.approx(90 * math.sin(math.radians(1.5)), abs=0.02)
    assert 45 * (x + 1) == pytest.approx(90, abs=0.1)


def test_the_rollout_knows_the_poses_of_s_and_of_s2() -> None:
    envs, rng, q = VecForest(WORLD, 3, iter(range(100))), np.random.default_rng(0), QNetwork(9)
    for _ in range(60):
        rollout, s = Rollout(1, q, envs), envs.reset_done()
        before = [true_pose(drone) for drone in envs.drones]
        s2, r, terminated, truncated, drones = envs.step(rng.integers(9, size=3))
        rollout.add(s, np.zeros(3), r, s2, terminated, truncated)
        *_, pose, pose2 = rollout.tensors()
        assert np.allclose(pose[0], before, atol=1e-5)
        assert np.allclose(pose2[0], [true_pose(drone) for drone in drones], atol=1e-5)
    assert len(envs.episodes) > 3


def test_the_network_tells_places_apart() -> None:
    q, s = QNetwork(9), torch.zeros(2, 4, 84, 84, dtype=torch.uint8)
    here, there = q(s, torch.tensor([[1.0, 0.0, -1.0, 0.0], [1.0, 0.0, 1.0, 0.0]]))
    assert not torch.allclose(here, there)


def test_a_training_cut_inside_a_rollout_and_resumed_is_uninterrupted(tmp_path: Path) -> None:
    c = MemoryConfig(**SMALL, steps=240)
    whole = finish(c, tmp_path / "whole")
    cut = finish(c, tmp_path / "cut", cuts=(8, 32, 112, 120, 232))
    assert_same_training(whole, cut)
    for a, b in zip(whole.replay.tensors(), cut.replay.tensors(), strict=True):
        assert torch.equal(a, b)
