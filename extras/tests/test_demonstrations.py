"""Recorded episodes come back as transitions; the margin by hand; interrupted trainings."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

import dqn
from deepflight import Config
from dqn import InputError
from env import fly
from extras.lessons import demonstrations
from extras.lessons.demonstrations import DemoConfig, load_demos, pretrain, read_demos
from extras.lessons.expert import laser_pilot
from extras.tests.test_expert import (
    SMALL,
    WORLD,
    assert_same_training,
    finish,
    little_to_fly,
    td_loss_by_hand,
)

__all__ = ["little_to_fly"]  # a fixture of all tests here too


def test_the_recipe_differs_from_dqn_s_in_its_exploring_and_its_own_settings() -> None:
    own, base = asdict(DemoConfig()), asdict(Config())
    assert {key: own[key] for key in own if own[key] != base.get(key)} == dict(
        epsilon_decay=1, demos="", demo_pilot="laser",
        demo_updates=2_000, demo_share=0.0, margin=5.0,
    )  # fmt: skip
    assert DemoConfig.pilot == "demonstrations"


def test_the_margin_loss_is_how_far_the_demonstrated_action_is_from_the_best_by_the_margin() -> (
    None
):
    rng = np.random.default_rng(0)
    q, a = rng.normal(0, 5, (500, 9)), rng.integers(9, size=500)
    missed = []
    for values, demonstrated in zip(q, a, strict=True):
        others = max(x for i, x in enumerate(values) if i != demonstrated)
        missed.append(max(others + 3.0 - values[demonstrated], 0))
    loss = demonstrations.margin_loss(torch.from_numpy(q), torch.from_numpy(a), 3.0)
    assert loss.numpy() == pytest.approx(missed)
    assert 0 < np.count_nonzero(missed) < 500


def filled(reward: float) -> dqn.Replay:
    """30 rows of 2 environments."""
    replay, none = dqn.Replay(80, 2), np.zeros(2, bool)
    for t in range(30):
        s = np.full((2, 4, 84, 84), t, np.uint8)
        replay.add(s, np.full(2, t % 9), np.full(2, reward), s, none, none)
    return replay


def test_a_share_of_each_batch_is_demonstrated() -> None:
    own, demo_replay, rng = filled(1.0), filled(2.0), np.random.default_rng(0)
    for share, n in ((0.0, 0), (0.25, 8), (1.0, 32)):
        b = demonstrations.sample(own, demo_replay, share, DemoConfig(n_steps=1), rng)
        assert len(b.r) == 32
        assert b.is_demo.sum() == n
        assert torch.equal(b.is_demo, b.r == 2)


def test_the_loss_is_that_of_td_targets_and_of_missed_margins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(dqn.DQNConfig, "bfloat16", False)
    c, rng = DemoConfig(n_steps=2, gamma=0.9, margin=3.0), np.random.default_rng(0)
    b = demonstrations.sample(filled(40.0), filled(40.0), 0.5, c, rng)
    agent = dqn.Agent(c, 9, rng)
    expected = td_loss_by_hand(agent, b)
    with torch.no_grad():
        missed = demonstrations.margin_loss(agent.q(b.s), b.a, 3.0)  # (B,)
    expected += 10 * missed[16:].sum().item() / 32
    demonstrations.learn(agent, b, c)
    assert agent.loss == pytest.approx(expected, rel=1e-4)


# -------------------------------------------------- trainings


@pytest.fixture
def demos(tmp_path: Path) -> str:
    """A file as eval --json writes it, two episodes of the laser pilot."""
    episodes = fly(laser_pilot(0.99), [0, 1], WORLD)
    path = tmp_path / "demos.json"
    path.write_text(json.dumps({"pilots": {"random": {}, "laser": {"episodes": episodes}}}))
    return str(path)


def test_a_training_with_demonstrations_interrupted_is_uninterrupted(
    tmp_path: Path, demos: str
) -> None:
    c = DemoConfig(**SMALL, steps=240, demo_updates=3, demos=demos, demo_share=0.25)
    whole = finish(c, tmp_path / "whole")
    assert_same_training(whole, finish(c, tmp_path / "cut", cuts=(8, 168, 208)))


def test_demonstrations_alone_come_before_all_else(tmp_path: Path, demos: str) -> None:
    c = DemoConfig(**SMALL, steps=80, demos=demos, demo_updates=7)
    run = finish(c, tmp_path / "run")
    updates = {state["step"].item() for state in run.agent.optimizer.state.values()}
    assert updates == {8}, "7 before the first step, and one of step 80"


def test_a_demonstrated_episode_becomes_its_actions_rewards_and_ends(demos: str) -> None:
    c = DemoConfig(demos=demos)
    replay, first = load_demos(read_demos(c), c, WORLD, lambda r, *_: r), read_demos(c)[0]
    steps = first["steps"]
    assert "".join(map(str, replay.actions[:steps, 0])) == first["actions"]
    assert replay.rewards[:steps, 0].sum() == pytest.approx(first["return"], abs=1e-3)
    assert np.flatnonzero(replay.ends[:, 0])[0] == steps - 1
    assert replay.added == replay.rows == sum(e["steps"] for e in read_demos(c))


def test_updates_on_demonstrations_alone_sync_the_target_network_too(demos: str) -> None:
    c, rng = DemoConfig(**SMALL, demos=demos), np.random.default_rng(0)
    replay = load_demos(read_demos(c), c, WORLD, lambda r, *_: r)
    for updates, same in ((4, True), (3, False)):  # target_every is 64 steps, of 16 an update
        agent = dqn.Agent(c, 9, rng)
        pretrain(agent, replay, replace(c, demo_updates=updates), rng)
        pairs = zip(agent.q.parameters(), agent.q_target.parameters(), strict=True)
        assert all(torch.equal(*pair) for pair in pairs) == same


def test_bad_demonstrations_are_named(demos: str) -> None:
    with pytest.raises(InputError, match="give --demos FILE"):
        read_demos(DemoConfig())
    with pytest.raises(InputError, match="no episodes of a pilot called me"):
        read_demos(DemoConfig(demos=demos, demo_pilot="me"))
    wrong = [read_demos(DemoConfig(demos=demos))[0] | {"outcome": "time"}]
    with pytest.raises(InputError, match="end elsewhere"):
        load_demos(wrong, DemoConfig(), WORLD, lambda r, *_: r)
    with pytest.raises(InputError, match="0 steps"):
        load_demos([], DemoConfig(), WORLD, lambda r, *_: r)
