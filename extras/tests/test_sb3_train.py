"""Stable-Baselines3 trains here, by its usual script and by ours, whose weights are ours."""

import csv
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor, load_results

import deepflight
from deepflight import RunConfig
from dqn import DQNConfig, QNetwork, check_output, load_weights, make_optimizer, save_weights
from env import OUTCOMES, World
from extras.bridges.export_onnx import states
from extras.bridges.gym_env import ID
from extras.bridges.sb3_train import ADAM_EPSILON, convert, main, make_model, make_test


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Two threads wait for each other, which takes seconds an update on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


class Logbook(gymnasium.Wrapper):
    """Writes down which forests are flown."""

    def reset(self, **kwargs: object) -> tuple:
        """As the environment does."""
        observation, info = self.env.reset(**kwargs)
        vars(self).setdefault("flown", []).append(info["forest"])
        return observation, info


def test_the_usual_script_runs_and_is_tested_in_forests_of_its_own(tmp_path: Path) -> None:
    env, test = Logbook(gymnasium.make(ID)), Logbook(gymnasium.make(ID, forests="test"))
    watched = Monitor(env, str(tmp_path / "log"), info_keywords=("outcome", "progress"))
    model = DQN("CnnPolicy", watched, buffer_size=400, learning_starts=100, seed=7, device="cpu")
    callback = EvalCallback(Monitor(test), n_eval_episodes=3, eval_freq=100)
    callback.eval_env.seed(7)
    model.learn(300, callback)
    assert test.flown[0] == 10**9 + 7 and len(test.flown) > 9
    assert all(10**9 <= forest < 2 * 10**9 for forest in test.flown)
    assert env.flown[0] == 7 and all(0 <= forest < 10**9 for forest in env.flown)

    table = load_results(str(tmp_path))
    assert set(table["outcome"]) <= {*OUTCOMES} and table["l"].sum() <= 300
    assert ((table["progress"] > 0) & (table["progress"] < 91)).all()

    model.save(tmp_path / "model")
    again = DQN.load(tmp_path / "model", device="cpu")
    observation, _ = env.reset(seed=3)
    over = False
    while not over:
        best = model.predict(observation, deterministic=True)[0]
        assert best == again.predict(observation, deterministic=True)[0]
        action = model.predict(observation)[0]
        assert action.shape == ()  # an array, where the core has an int
        observation, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated


def test_the_converted_network_has_the_trained_ones_values_and_flies(tmp_path: Path) -> None:
    model = make_model(DQNConfig(steps=400, learning_starts=200), RunConfig(), replay=800)
    before = convert(model).state_dict()["conv.0.weight"].clone()
    q = convert(model.learn(400))
    assert not torch.equal(q.state_dict()["conv.0.weight"], before), "it learnt nothing"
    s = states(q, World(), 50)
    with torch.no_grad():
        theirs = model.q_net(torch.from_numpy(s))  # (50, 9)
        ours = q(torch.from_numpy(s))  # (50, 9)
    assert torch.allclose(ours, theirs, rtol=1e-5, atol=1e-5)
    assert np.array_equal(model.predict(s, deterministic=True)[0], ours.argmax(1))
    save_weights(tmp_path / "sb3.pt", q, beacon=False, camera="grey")
    fly = ["eval", "--weights", str(tmp_path / "sb3.pt"), "--episodes", "2", "--pilots", "dqn"]
    assert deepflight.main([*fly, "--out", str(tmp_path)]) == 0


def test_returns_and_lengths_are_logged_and_tests_fly_forests_of_their_own(tmp_path: Path) -> None:
    c, r = DQNConfig(steps=400, learning_starts=200), RunConfig(test_every=200)
    model, test = make_model(c, r, replay=800), make_test(c, r)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(400, test, log_interval=1)
    rows = list(csv.DictReader((tmp_path / "progress.csv").read_text().splitlines()))
    last = [row for row in rows if row["rollout/ep_len_mean"]][-1]
    flights = list(model.ep_info_buffer)
    assert float(last["rollout/ep_rew_mean"]) == pytest.approx(np.mean([f["r"] for f in flights]))
    assert float(last["rollout/ep_len_mean"]) == pytest.approx(np.mean([f["l"] for f in flights]))
    assert sum(bool(row["eval/mean_reward"]) for row in rows) == 2
    assert all(0 <= env.flyer.seed < 10**9 for env in model.env.venv.envs)
    assert all(10**9 <= env.flyer.seed < 2 * 10**9 for env in test.eval_env.venv.envs)


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


BAD = {
    "steps is 0": ["--steps", "0"],
    "steps is -5": ["--steps", "-5"],
    "steps is 5000": ["--steps", "5000"],
    "steps is 1000": ["--steps", str(10**400)],
    "'many'": ["--steps", "many"],
    "": ["--out", ""],
    "folder": ["--out", "folder"],
    "diary": ["--out", "diary"],
    "diary/sb3.pt": ["--out", "diary/sb3.pt"],
    "/proc/sb3.pt": ["--out", "/proc/sb3.pt"],
    "aaa": ["--out", "a" * 300],
    "--pilot": ["--pilot", "straight"],
}


@pytest.mark.parametrize("value", BAD)
def test_a_bad_command_line_gets_one_line_and_nothing_is_written(
    value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "diary").write_text("dear diary")
    assert main(BAD[value]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("sb3_train: error: ") and err.count("\n") == 1
    assert value in err
    assert {path.name for path in tmp_path.rglob("*")} == {"folder", "diary"}
    assert (tmp_path / "diary").read_text() == "dear diary"


def test_weights_may_be_replaced_and_new_folders_named(tmp_path: Path) -> None:
    old, new = tmp_path / "old.pt", tmp_path / "a" / "b" / "new.pt"
    save_weights(old, QNetwork(9), beacon=False, camera="grey")
    for path in (old, new):
        check_output(path, b"PK.*weights")
    assert list(tmp_path.iterdir()) == [old]


@pytest.mark.long
def test_ctrl_c_saves_the_weights_so_far(tmp_path: Path) -> None:
    out = tmp_path / "new" / "sb3.pt"
    command = [sys.executable, "-u", "-m", "extras.bridges.sb3_train", "--out", str(out)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=Path(__file__).parents[2], **pipes) as training:
        shown = next(line for line in training.stdout if "ep_rew_mean" in line)  # a hundred flights
        training.send_signal(signal.SIGINT)
        rest, errors = training.communicate()
    assert training.returncode == 130 and shown
    assert "Traceback" not in errors
    assert re.match(r"interrupted at step [\d,]+; wrote \S+; fly it: ", rest.splitlines()[-1])
    load_weights(out, World.actions, beacon=False, camera="grey")


@pytest.mark.long
def test_a_whole_training_by_the_command_line_writes_weights(tmp_path: Path) -> None:
    out = tmp_path / "sb3.pt"
    assert main(["--steps", "5100", "--beacon", "--out", str(out)]) == 0
    load_weights(out, World.actions, beacon=True, camera="grey")
