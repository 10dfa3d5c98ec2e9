"""Mnih's optimizer by hand, and his settings."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

import deepflight
import dqn
from extras.lessons.mnih import MnihConfig, RMSprop, TextbookConfig
from extras.tests.test_expert import SMALL, assert_same_training, finish, little_to_fly

__all__ = ["little_to_fly"]  # a fixture of all tests here too


def test_three_updates_of_mnihs_rmsprop_by_hand() -> None:
    w = torch.zeros(1, requires_grad=True)
    optimizer, places = RMSprop([w], lr=0.1), []
    for g in (2.0, -1.0, 3.0):
        w.grad = torch.tensor([g])
        optimizer.step()
        places.append(w.item())
    # running means of g: 0.1, 0.045, 0.19275, and of g^2: 0.2, 0.24, 0.678
    variances = 0.2 - 0.1**2, 0.24 - 0.045**2, 0.678 - 0.19275**2
    steps = [-0.1 * g / v**0.5 for g, v in zip((2, -1, 3), variances, strict=True)]
    assert places == pytest.approx(np.cumsum(steps).tolist(), rel=1e-4)


def test_mnihs_epsilon_stands_inside_the_root_and_belongs_to_a_sum_of_32() -> None:
    w = torch.zeros(1, requires_grad=True)
    w.grad = torch.tensor([1e-5])  # so small that its variance counts for nothing
    RMSprop([w], lr=1.0).step()
    of_the_sum = 32 * 1e-5 / 0.01**0.5
    assert w.item() == pytest.approx(-of_the_sum, rel=1e-3)


def test_the_settings_are_extended_data_table_1() -> None:
    c = MnihConfig()
    assert (c.steps, c.replay_size, c.learning_starts) == (1_400_000, 1_000_000, 50_000)
    assert (c.batch_size, c.epsilon_final, c.epsilon_decay) == (32, 0.1, 1_000_000)
    assert (c.update_every, c.target_every, c.gamma, c.lr) == (4, 10_000, 0.99, 2.5e-4)
    assert (c.forward_reward, c.goal_bonus, c.far_bonus) == (0, 0, 0)


def test_the_textbook_has_no_piece_that_is_marked_but_num_envs() -> None:
    recipe, book = asdict(deepflight.Config()), asdict(TextbookConfig())
    marked = {f.name for f in dqn.fields(deepflight.Config) if f.metadata["help"].startswith("[+]")}
    assert {key for key in book if book[key] != recipe[key]} == marked - {"num_envs", "beacon"}


def test_a_training_with_rmsprop_interrupted_is_uninterrupted(tmp_path: Path) -> None:
    c = MnihConfig(**SMALL, steps=240)
    whole = finish(c, tmp_path / "whole")
    assert not c.bfloat16
    assert isinstance(whole.agent.optimizer, RMSprop)
    assert_same_training(whole, finish(c, tmp_path / "cut", cuts=(8, 168)))
