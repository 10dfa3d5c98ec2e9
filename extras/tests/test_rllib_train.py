"""RLlib trains here, with two runners, and what it trained is a weights file of ours."""

from pathlib import Path

import pytest
import ray
import torch

import deepflight
from deepflight import RunConfig
from dqn import DQNConfig, load_weights, make_optimizer
from env import World
from extras.bridges.rllib_train import make_config, start, train

pytestmark = pytest.mark.long


def test_two_runners_train_a_network_that_flies(tmp_path: Path) -> None:
    out = tmp_path / "rllib.pt"
    start(None)
    try:
        train(DQNConfig(steps=2000, learning_starts=200), RunConfig(), runners=2, out=out)
        other = tmp_path / "untrained.pt"
        train(DQNConfig(steps=1000), RunConfig(), runners=2, out=other)
    finally:
        ray.shutdown()
    saved = (load_weights(path, World.actions, beacon=False) for path in (out, other))
    trained, untrained = (q.state_dict() for q in saved)
    assert not torch.equal(trained["head.2.bias"], untrained["head.2.bias"]), "it learnt nothing"
    fly = ["eval", "--weights", str(out), "--episodes", "2", "--pilots", "dqn"]
    assert deepflight.main([*fly, "--out", str(tmp_path)]) == 0


@pytest.mark.parametrize("runners", [1, 2, 7])
def test_one_batch_is_learnt_every_four_steps_whatever_the_runners(runners: int) -> None:
    from ray.rllib.algorithms.dqn.dqn import calculate_rr_weights

    config = make_config(DQNConfig(), RunConfig(), runners)
    flown = config.rollout_fragment_length * config.num_envs_per_env_runner * runners  # a round
    sampled, learnt = calculate_rr_weights(config)
    assert learnt / (sampled * flown) == pytest.approx(1 / DQNConfig.update_every)
    ours = make_optimizer([torch.zeros(1)], DQNConfig())
    assert config.adam_epsilon == ours.defaults["eps"]
