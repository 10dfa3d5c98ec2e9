"""RLlib trains here, with two runners or on three nodes; what it trained is a weights file of ours.

Every test but those of the command line is long.
"""

import subprocess
import sys
from pathlib import Path

import pytest
import ray
import torch

import deepflight
from deepflight import RunConfig
from dqn import DQNConfig, load_weights, make_optimizer
from env import World
from extras.bridges.rllib_train import ROOT, main, make_config, start, train
from extras.experiments.nodes import fly, kill, number


@pytest.mark.long
def test_two_runners_train_a_network_that_flies(tmp_path: Path) -> None:
    out = tmp_path / "rllib.pt"
    start(None, runners=2)
    try:
        train(DQNConfig(steps=2000, learning_starts=200), RunConfig(), runners=2, out=out)
        other = tmp_path / "untrained.pt"
        train(DQNConfig(steps=1000), RunConfig(), runners=2, out=other)
    finally:
        ray.shutdown()
    world = {"beacon": False, "camera": "grey"}
    saved = (load_weights(path, World.actions, **world) for path in (out, other))
    trained, untrained = (q.state_dict() for q in saved)
    assert not torch.equal(trained["head.2.bias"], untrained["head.2.bias"]), "it learnt nothing"
    fly = ["eval", "--weights", str(out), "--episodes", "2", "--pilots", "dqn"]
    assert deepflight.main([*fly, "--out", str(tmp_path)]) == 0


@pytest.mark.long
def test_a_training_on_three_nodes_outlives_one_of_them(tmp_path: Path) -> None:
    out = tmp_path / "rllib.pt"
    passed, added = fly(3, steps=5_100, out=out, midway=kill)  # the last hundred steps learn
    steps = [number(line[1]) for line in passed]
    assert steps[0] < 2_000 and steps[-1] >= 5_100, "it ended before, or with, the node"
    flown = [number(line[1]) for line in added]
    assert len(flown) == 3 and sum(flown) == steps[-1], "a step is counted nowhere, or twice"
    assert [number(line[1]) for line in added if line[3]] == [min(flown)], "one node was lost"
    assert load_weights(out, World.actions, beacon=False, camera="grey")
    pilot = ["eval", "--weights", str(out), "--episodes", "2", "--pilots", "dqn"]
    command = [sys.executable, "deepflight.py", *pilot, "--out", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True)


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        *(("--steps", value) for value in ("0", "-1", "x", "nan", "1" + 400 * "0")),
        *(("--runners", value) for value in ("0", "1000000000", "two")),
        *(("--address", value) for value in ("", "nonsense", "ray://127.0.0.1:1")),
        *(("--out", value) for value in ("", ".", "README.md", "README.md/x.pt", "/dev/null")),
        ("--out", 300 * "x"),
    ],
)
def test_a_bad_command_line_is_one_line_and_starts_nothing(
    flag: str, value: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main([flag, value]) == 2
    out, error = capfd.readouterr()
    assert not out and error.count("\n") == 1 and (flag in error or value in error)
    assert not ray.is_initialized()


@pytest.mark.long
def test_no_ray_at_the_address_is_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["--address", "127.0.0.1:1"]) == 1
    out, error = capfd.readouterr()
    assert not out and error.count("\n") == 1 and "127.0.0.1:1" in error


@pytest.mark.long
@pytest.mark.parametrize("runners", [1, 2, 7])
def test_one_batch_is_learnt_every_four_steps_whatever_the_runners(runners: int) -> None:
    from ray.rllib.algorithms.dqn.dqn import calculate_rr_weights

    config = make_config(DQNConfig(), RunConfig(), runners)
    flown = config.rollout_fragment_length * config.num_envs_per_env_runner * runners  # a round
    sampled, learnt = calculate_rr_weights(config)
    assert learnt / (sampled * flown) == pytest.approx(1 / DQNConfig.update_every)
    ours = make_optimizer([torch.zeros(1)], DQNConfig())
    assert config.adam_epsilon == ours.defaults["eps"]
