"""Stable-Baselines3 trains here, and what it trained is a weights file of ours."""

from pathlib import Path

import numpy as np
import pytest
import torch

import deepflight
from deepflight import RunConfig
from dqn import DQNConfig, make_optimizer, save_weights
from env import World
from extras.bridges.export_onnx import states
from extras.bridges.sb3_train import ADAM_EPSILON, convert, make_model

pytestmark = pytest.mark.long


def test_the_converted_network_has_the_trained_ones_values_and_flies(tmp_path: Path) -> None:
    model = make_model(DQNConfig(steps=400, learning_starts=200), RunConfig(), replay=800)
    before = convert(model).state_dict()["conv.0.weight"].clone()
    model.learn(400)
    q = convert(model)
    assert not torch.equal(q.state_dict()["conv.0.weight"], before), "it learnt nothing"
    s = states(q, World(), 50)
    with torch.no_grad():
        theirs = model.q_net(torch.from_numpy(s))  # (50, 9)
        ours = q(torch.from_numpy(s))  # (50, 9)
    assert torch.allclose(ours, theirs, rtol=1e-5, atol=1e-5)
    assert np.array_equal(model.predict(s, deterministic=True)[0], ours.argmax(1))
    save_weights(tmp_path / "sb3.pt", q, beacon=False)
    fly = ["eval", "--weights", str(tmp_path / "sb3.pt"), "--episodes", "2", "--pilots", "dqn"]
    assert deepflight.main([*fly, "--out", str(tmp_path)]) == 0


def test_the_settings_are_ours() -> None:
    c = DQNConfig()
    model = make_model(c, RunConfig(), replay=800)
    assert model.gradient_steps / model.n_envs == 1 / c.update_every
    assert model.target_update_interval == c.target_every * c.update_every
    assert (model.batch_size, model.gamma, model.n_steps) == (c.batch_size, c.gamma, c.n_steps)
    assert [model.lr_schedule(left) for left in (1, 0)] == pytest.approx([c.lr, c.lr * c.lr_decay])
    eps = [model.exploration_schedule(1 - step / c.steps) for step in (0, c.epsilon_decay, c.steps)]
    assert eps == pytest.approx([1, c.epsilon_final, c.epsilon_final])
    ours = make_optimizer(model.q_net.parameters(), c)
    assert model.policy.optimizer.defaults["eps"] == ADAM_EPSILON == ours.defaults["eps"]
