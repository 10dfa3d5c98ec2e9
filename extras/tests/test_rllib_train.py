"""RLlib trains here, with two runners or on three nodes; what it trained is a weights file of ours.

Every test but those of the command line is long.
"""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import ray
import torch

import deepflight
from deepflight import load_weights
from dqn import Agent
from env import World
from extras.bridges.rllib_train import ROOT, RLlibConfig, main, make_config, start, train
from extras.experiments.nodes import fly, kill, number


@pytest.mark.long
def test_two_runners_train_a_network_that_flies(tmp_path: Path) -> None:
    out = tmp_path / "rllib.pt"
    start(None, runners=2)
    try:
        train(RLlibConfig(steps=2000, learning_starts=200), runners=2, out=out)
        other = tmp_path / "untrained.pt"
        train(RLlibConfig(steps=1000), runners=2, out=other)
    finally:
        ray.shutdown()
    trained, untrained = (load_weights(path)[0].state_dict() for path in (out, other))
    assert not torch.equal(trained["head.2.bias"], untrained["head.2.bias"]), "it learnt nothing"
    fly = ["eval", "--weights", str(out), "--episodes", "2"]
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
    assert load_weights(out)[1:] == (World(), "rllib")
    pilot = ["eval", "--weights", str(out), "--episodes", "2"]
    command = [sys.executable, "deepflight.py", *pilot, "--out", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True)


def exit_code(words: str) -> int:
    """What main returns, or argparse exits with."""
    try:
        return main(words.split())
    except SystemExit as error:
        return error.code


@pytest.mark.parametrize(
    ("words", "why"),
    [("--steps 0", "steps is 0"), ("--steps nan", "'nan'"), ("--out .", "directory"),
     ("--out README.md/x.pt", "README.md")],
)  # fmt: skip
def test_a_bad_command_line_is_one_line_and_starts_nothing(
    words: str, why: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(words) == 2
    out, error = capfd.readouterr()
    assert not out and error.count("\n") == 1 and why in error
    assert not ray.is_initialized()


@pytest.mark.long
def test_no_ray_at_the_address_is_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["--address", "127.0.0.1:1"]) == 2
    out, error = capfd.readouterr()
    assert not out and error.count("\n") == 1 and "127.0.0.1:1" in error


@pytest.mark.long
@pytest.mark.parametrize("runners", [1, 2, 7])
def test_one_batch_is_learnt_every_four_steps_whatever_the_runners(runners: int) -> None:
    from ray.rllib.algorithms.dqn.dqn import calculate_rr_weights

    c = RLlibConfig()
    config = make_config(c, runners)
    flown = config.rollout_fragment_length * config.num_envs_per_env_runner * runners  # a round
    sampled, learnt = calculate_rr_weights(config)
    assert learnt / (sampled * flown) == pytest.approx(1 / c.update_every)
    ours = Agent(replace(c, huber_delta=1.0), 9, np.random.default_rng(0)).optimizer
    assert config.adam_epsilon == ours.defaults["eps"]
