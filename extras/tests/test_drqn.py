"""Hidden states: kept step by step, unrolled over a rollout, alone and side by side."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import dqn
from env import VecForest, World
from extras.lessons import drqn
from extras.lessons.drqn import HIDDEN, NONE, Agent, DRQNConfig, QNetwork, Rollout, learn
from extras.tests.test_expert import assert_same_training, finish, little_to_fly

__all__ = ["little_to_fly"]  # a fixture of all tests here too
SMALL = {"num_envs": 8, "rollout": 4, "batch_size": 4}
WORLD = World()


def flown(q: QNetwork, seeds: list[int], envs: int, steps: int) -> dict[tuple[int, int], Tensor]:
    """The hidden state of each episode (its seed) and step; actions vary by both."""
    forest, states = VecForest(WORLD, envs, seeds), {}
    for _ in range(steps):
        if not len(forest.reset_done()):
            break
        for drone, h in zip(forest.active, q.hidden_states(forest.active), strict=True):
            states[drone.seed, len(drone.actions)] = h
        forest.step([(drone.seed + len(drone.actions)) % 9 for drone in forest.active])
    return states


def test_side_by_side_drones_remember_what_each_remembers_alone() -> None:
    q, seeds = QNetwork(9), [3, 4, 5]
    together = flown(q, seeds, 3, 12)
    for seed in seeds:
        for key, h in flown(q, [seed], 1, 12).items():
            assert torch.allclose(h, together[key], atol=1e-5), key
    assert len(together) > 30


def test_the_control_forgets_its_hidden_state() -> None:
    torch.manual_seed(0)
    q, control = QNetwork(9), drqn.Forgetful(9)
    control.load_state_dict(q.state_dict())
    x, last, h = torch.randn(5, 266), torch.randint(9, (5,)), torch.randn(5, HIDDEN)
    empty = q.recall(x, last, torch.zeros(5, HIDDEN))
    assert torch.equal(control.recall(x, last, h), empty)
    assert not torch.allclose(q.recall(x, last, h), empty)


def test_asking_twice_in_a_step_changes_nothing() -> None:
    q, forest = QNetwork(9), VecForest(WORLD, 2, [3, 4])
    for _ in range(3):
        forest.reset_done()
        once = q.hidden_states(forest.active)
        assert torch.equal(q.hidden_states(forest.active), once)
        assert torch.equal(q.hidden_states(forest.active[1:]), once[1:])
        forest.step([8, 0])


def test_stepping_is_unrolling_and_an_episode_begins_with_an_empty_state() -> None:
    """Drones that fly at random for 60 steps crash and begin again, all in one long rollout."""
    q, envs, rng = QNetwork(9), VecForest(WORLD, 3, iter(range(100))), np.random.default_rng(0)
    rollout, stepped = Rollout(60, envs), []
    for _ in range(60):
        s = envs.reset_done()
        stepped.append(q.hidden_states(envs.drones))
        a = rng.integers(9, size=3)
        s2, r, terminated, truncated, _ = envs.step(a)
        rollout.add(s, a, r, s2, terminated, truncated)
    s, a, *_, last = rollout.tensors()
    junk = torch.randn(3, HIDDEN)  # of an episode before: must not be seen
    assert torch.allclose(q.unroll(s, last, junk), torch.stack(stepped), atol=1e-5)
    begun, ended = last[1:] == NONE, rollout.tensors()[4][:-1]
    assert len(envs.episodes) > 3
    assert torch.equal(begun, ended)
    assert torch.equal(last[1:][~begun], a[:-1][~begun])


def test_the_agent_of_a_training_remembers_what_a_pilot_does() -> None:
    c, rng = DRQNConfig(**SMALL), np.random.default_rng(0)
    agent, envs = Agent(c, 9, rng), VecForest(WORLD, 8, iter(range(100)))
    for t in range(40):
        s = envs.reset_done()
        before = agent.hidden.clone()
        values = agent.remember(s, envs.drones, t % 4 == 0)
        assert np.allclose(values, agent.q.values(s, envs.drones), atol=1e-4)
        assert torch.allclose(agent.hidden, agent.q.hidden_states(envs.drones), atol=1e-5)
        assert t % 4 or torch.equal(agent.first, before)
        envs.step(rng.integers(9, size=8))


def test_the_first_frames_reach_the_last_step_of_the_same_episode_only() -> None:
    q, s = QNetwork(9), torch.randint(256, (5, 1, 4, 84, 84), dtype=torch.uint8)
    last, h = torch.tensor([[NONE], [1], [2], [3], [4]]), torch.zeros(1, HIDDEN)
    other = s.clone()
    other[0] = 255 - other[0]
    one, two = (q.head(q.unroll(x, last, h)[-1]) for x in (s, other))
    assert not torch.allclose(one, two, atol=1e-6)
    cut = last.clone()
    cut[3] = NONE  # another episode: what came before is forgotten
    one, two = (q.head(q.unroll(x, cut, h)[-1]) for x in (s, other))
    assert torch.equal(one, two)


def test_learning_lowers_the_loss_of_the_same_rollout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dqn.DQNConfig, "bfloat16", False)
    c, rng = DRQNConfig(**SMALL, epochs=1, gamma=0.0, lr=1e-3), np.random.default_rng(0)
    agent, envs = Agent(c, 9, rng), VecForest(WORLD, 8, iter(range(100)))
    rollout = Rollout(4, envs)
    for t in range(4):
        s = envs.reset_done()
        agent.remember(s, envs.drones, t == 0)
        a = rng.integers(9, size=8)
        s2, r, terminated, truncated, _ = envs.step(a)
        rollout.add(s, a, r, s2, terminated, truncated)
    losses = []
    for _ in range(30):
        learn(agent, rollout, c, rng)
        losses.append(agent.loss)
    assert losses[-1] < losses[0] / 2


def test_a_training_cut_inside_a_rollout_and_resumed_is_uninterrupted(tmp_path: Path) -> None:
    c = DRQNConfig(**SMALL, steps=240)
    whole = finish(c, tmp_path / "whole")
    cut = finish(c, tmp_path / "cut", cuts=(8, 32, 112, 120, 232))
    assert_same_training(whole, cut)
    for a, b in zip(whole.replay.tensors(), cut.replay.tensors(), strict=True):
        assert torch.equal(a, b)
