"""RLlib trains here, with two runners or on three nodes; what it trained is a weights file of ours.

Every test but those of the command line is long.
"""

import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import ray
import torch
from ray.cluster_utils import Cluster

import deepflight
from deepflight import load_weights
from dqn import Agent
from env import World
from extras.bridges.rllib_train import ROOT, RLlibConfig, main, make_config, start, train

PASSED = re.compile(r"^ *([\d,]+) steps, +\d+ a second")
ADDED = re.compile(r"^node .*: ([\d,]+) steps, \d+ a second, .*?(lost.*)?$")


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
    out, passed, added = tmp_path / "rllib.pt", [], []
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})  # all on this machine
    try:
        for _ in range(2):
            cluster.add_node(num_cpus=1)
        command = [sys.executable, "-m", "extras.bridges.rllib_train", "--runners", "3"]
        command += ["--address", cluster.address, "--out", str(out)]
        command += ["--steps", "5100"]  # the last hundred learn
        environ = os.environ | {"OMP_NUM_THREADS": "1"}  # the runners need the other cores
        with subprocess.Popen(
            command, cwd=ROOT, env=environ, stdout=subprocess.PIPE, text=True
        ) as run:
            for line in run.stdout:
                passed += PASSED.findall(line)
                added += ADDED.findall(line.rstrip())
                if len(cluster.worker_nodes) == 2 and passed:  # let its processes say no goodbye
                    cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
    finally:
        cluster.shutdown()
    assert run.returncode == 0
    steps = [int(text.replace(",", "")) for text in passed]
    assert steps[0] < 2_000 and steps[-1] >= 5_100, "it ended before, or with, the node"
    flown = [int(text.replace(",", "")) for text, _ in added]
    assert len(flown) == 3 and sum(flown) == steps[-1], "a step is counted nowhere, or twice"
    lost = [steps for steps, (_, why) in zip(flown, added, strict=True) if why]
    assert lost == [min(flown)], "one node was lost"
    assert load_weights(out)[1:] == (World(), "rllib")
    pilot = ["eval", "--weights", str(out), "--episodes", "2"]
    command = [sys.executable, "deepflight.py", *pilot, "--out", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True)


@pytest.mark.long
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGUSR1"])
def test_a_signal_saves_the_weights_so_far(name: str, tmp_path: Path) -> None:
    out, number = tmp_path / "rllib.pt", getattr(signal, name)
    command = [sys.executable, "-m", "extras.bridges.rllib_train", "--runners", "1"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([*command, "--out", str(out)], cwd=ROOT, **pipes) as training:
        shown = next(line for line in training.stdout if PASSED.match(line))
        training.send_signal(number)
        rest, errors = training.communicate()
    assert training.returncode == 128 + number and shown
    assert "Traceback" not in errors
    assert re.match(r"interrupted; wrote \S+; fly it: ", rest.splitlines()[-1])
    assert load_weights(out)[1:] == (World(), "rllib")


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
