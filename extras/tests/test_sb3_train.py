"""Stable-Baselines3 trains here, by its usual script and by ours, whose weights are ours."""

import csv
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor, load_results

import deepflight
from deepflight import load_weights, save_weights
from dqn import Agent
from env import OUTCOMES, World
from extras.bridges.export_onnx import observations
from extras.bridges.gym_env import ID
from extras.bridges.sb3_train import (
    ADAM_EPSILON,
    SB3Config,
    Validation,
    convert,
    main,
    make_model,
    train,
)
from extras.bridges.signals import ended_by_signals


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Two threads wait for each other, which takes seconds an update on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


class Often(SB3Config):
    """Validates as often as a short training needs."""

    validate_every: ClassVar[int] = 200


class Logbook(gymnasium.Wrapper):
    """Writes down which forests are flown."""

    def reset(self, **kwargs: object) -> tuple:
        """As the environment does."""
        observation, info = self.env.reset(**kwargs)
        vars(self).setdefault("flown", []).append(info["forest"])
        return observation, info


def test_the_usual_script_runs_and_is_validated_in_forests_of_its_own(tmp_path: Path) -> None:
    env = Logbook(gymnasium.make(ID))
    validation = Logbook(gymnasium.make(ID, forests="validation"))
    watched = Monitor(env, str(tmp_path / "log"), info_keywords=("outcome", "progress"))
    model = DQN("CnnPolicy", watched, buffer_size=400, learning_starts=100, seed=7, device="cpu")
    callback = EvalCallback(Monitor(validation), n_eval_episodes=3, eval_freq=100)
    callback.eval_env.seed(7)
    model.learn(300, callback)
    assert validation.flown[0] == 10**9 + 7 and len(validation.flown) > 9
    assert all(10**9 <= forest < 2 * 10**9 for forest in validation.flown)
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


def test_the_converted_network_has_the_trained_ones_values_and_flies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = make_model(c := SB3Config(steps=400, learning_starts=200), replay=800)
    before = convert(model).state_dict()["conv.0.weight"].clone()
    q = convert(model.learn(400))
    assert not torch.equal(q.state_dict()["conv.0.weight"], before), "it learnt nothing"
    s = observations(q, World(), 50)
    with torch.no_grad():
        theirs = model.q_net(torch.from_numpy(s))  # (50, 9)
        ours = q(torch.from_numpy(s))  # (50, 9)
    assert torch.allclose(ours, theirs, rtol=1e-5, atol=1e-5)
    assert np.array_equal(model.predict(s, deterministic=True)[0], ours.argmax(1))
    save_weights(tmp_path / "sb3.pt", q, c)
    fly = ["eval", "--weights", str(tmp_path / "sb3.pt"), "--episodes", "2"]
    assert deepflight.main([*fly, "--out", str(tmp_path)]) == 0
    assert "sb3" in capsys.readouterr().out


def test_returns_and_lengths_are_logged_and_validation_has_its_own_forests(tmp_path: Path) -> None:
    c = Often(steps=400, learning_starts=200)
    model, validation = make_model(c, replay=800), Validation(c, tmp_path / "best.pt")
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(400, validation, log_interval=1)
    rows = list(csv.DictReader((tmp_path / "progress.csv").read_text().splitlines()))
    last = [row for row in rows if row["rollout/ep_len_mean"]][-1]
    episodes = list(model.ep_info_buffer)
    assert float(last["rollout/ep_rew_mean"]) == pytest.approx(np.mean([e["r"] for e in episodes]))
    assert float(last["rollout/ep_len_mean"]) == pytest.approx(np.mean([e["l"] for e in episodes]))
    assert sum(bool(row["eval/mean_reward"]) for row in rows) == 2
    assert float(last["rollout/success_rate"]) == 0
    assert sum(bool(row["eval/success_rate"]) for row in rows) == 2
    assert all(0 <= env.drone.seed < 10**9 for env in model.env.venv.envs)
    assert all(10**9 <= env.drone.seed < 2 * 10**9 for env in validation.eval_env.venv.envs)


class Flown(Validation):
    """Writes down every forest, and the scores: of each validation, and the best so far."""

    def __init__(self, c: SB3Config, best: Path) -> None:
        super().__init__(c, best)
        self.forests, self.scores, self.bests = [], [], []

    def _on_step(self) -> bool:
        going = super()._on_step()
        if self.ended:
            self.scores.append(tuple(np.mean(self.ended, 0)))
            self.bests.append(self.score)
        return going

    def _log_success_callback(self, locals_: dict, globals_: dict) -> None:
        super()._log_success_callback(locals_, globals_)
        self.forests += [locals_["info"]["forest"]] if locals_["done"] else []


def test_every_validation_flies_the_same_forests(tmp_path: Path) -> None:
    c = Often(steps=600, learning_starts=200)
    validation = Flown(c, tmp_path / "best.pt")
    make_model(c, replay=800).learn(600, validation)
    assert len(validation.forests) == 3 * 24
    events = [sorted(validation.forests[i : i + 24]) for i in (0, 24, 48)]
    assert events[0] == events[1] == events[2] and len({*events[0]}) == 24
    assert validation.bests == [max(validation.scores[: i + 1]) for i in range(3)]


@pytest.mark.parametrize(
    ("beacon", "ends", "scores"),
    [(False, ["far", "crash"], (0.5, 45.0)), (True, ["far", "goal"], (0.5, 45.0)),
     (False, ["goal", "far"], (1.0, 45.0)), (True, ["far", "far"], (0.0, 45.0))],
)  # fmt: skip
def test_the_score_is_the_share_that_crossed_or_with_the_beacon_arrived_then_the_progress(
    beacon: bool, ends: list[str], scores: tuple[float, float], tmp_path: Path
) -> None:
    validation = Validation(SB3Config(beacon=beacon), tmp_path / "best.pt")
    validation.ended = []
    for outcome, progress in zip(ends, (30.0, 60.0), strict=True):
        crossed = outcome in ("goal", "far")
        told = {"outcome": outcome, "is_success": crossed, "progress": progress}
        validation._log_success_callback({"info": told, "done": True}, {})
    assert tuple(np.mean(validation.ended, 0)) == scores


def test_the_weights_of_the_best_validation_are_kept_beside_the_last(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    c = Often(steps=600, learning_starts=200)
    assert train(c, tmp_path / "x.pt") == 0
    assert f"wrote {tmp_path / 'x.pt'}, and the best of validation, {tmp_path / 'x-best.pt'}" in (
        capsys.readouterr().out
    )
    assert load_weights(tmp_path / "x-best.pt")[1:] == load_weights(tmp_path / "x.pt")[1:]
    validation = Flown(c, tmp_path / "again.pt")
    model = make_model(c, replay=600)
    model.learn(600, validation)
    best = load_weights(tmp_path / "again.pt")[0].state_dict()
    ours = load_weights(tmp_path / "x-best.pt")[0].state_dict()
    assert all(torch.equal(best[key], ours[key]) for key in best)


@pytest.mark.parametrize(
    ("words", "starts"), [("--steps 400", 200), ("--steps 400 --learning-starts 100", 100)]
)
def test_a_short_training_learns_from_half_of_its_steps_on_or_sooner_if_told(
    words: str, starts: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "x.pt"
    assert main([*words.split(), "--out", str(out)]) == 0
    assert f"400 steps, from {starts} on it learns" in capsys.readouterr().out
    save_weights(tmp_path / "new.pt", convert(make_model(SB3Config(), replay=800)), SB3Config())
    new, trained = (load_weights(path)[0].state_dict() for path in (tmp_path / "new.pt", out))
    assert not torch.equal(new["head.2.bias"], trained["head.2.bias"])


def test_the_settings_are_ours() -> None:
    c = SB3Config()
    model = make_model(c, replay=800)
    assert model.gradient_steps / model.n_envs == 1 / c.update_every
    assert model.target_update_interval == c.target_every
    assert (model.batch_size, model.gamma, model.n_steps) == (c.batch_size, c.gamma, c.n_steps)
    assert [model.lr_schedule(left) for left in (1, 0)] == pytest.approx([c.lr, c.lr * c.lr_final])
    eps = [model.exploration_schedule(1 - step / c.steps) for step in (0, c.epsilon_decay, c.steps)]
    assert eps == pytest.approx([1, c.epsilon_final, c.epsilon_final])
    ours = Agent(replace(c, huber_delta=1.0), 9, np.random.default_rng(0)).optimizer
    assert model.policy.optimizer.defaults["eps"] == ADAM_EPSILON == ours.defaults["eps"]


def exit_code(words: str) -> int:
    """What main returns, or argparse exits with."""
    try:
        return main(words.split())
    except SystemExit as error:
        return error.code


@pytest.mark.parametrize(
    ("words", "why"),
    [("--steps 0", "steps is 0"), ("--steps many", "'many'"), ("--pilot dqn", "--pilot"),
     ("--learning-starts 0", "learning_starts is 0"), ("--learning-starts 71", "learning_starts"),
     ("--out .", "directory"), ("--out README.md/sb3.pt", "README.md")],
)  # fmt: skip
def test_a_bad_command_line_gets_one_line(
    words: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(words) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("sb3_train: ") and err.count("\n") == 1 and why in err


@pytest.mark.parametrize(
    "name", ["SIGUSR1", *(pytest.param(f"SIG{x}", marks=pytest.mark.long) for x in ("INT", "TERM"))]
)
def test_a_signal_saves_the_weights_so_far(name: str, tmp_path: Path) -> None:
    out, number = tmp_path / "new" / "sb3.pt", getattr(signal, name)
    command = [sys.executable, "-u", "-m", "extras.bridges.sb3_train", "--out", str(out)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=Path(__file__).parents[2], **pipes) as training:
        shown = next(line for line in training.stdout if "it learns" in line)  # so it has begun
        training.send_signal(number)
        rest, errors = training.communicate()
    assert training.returncode == 128 + number and shown
    assert "Traceback" not in errors
    assert re.match(r"interrupted at step [\d,]+; wrote \S+; fly it: ", rest.splitlines()[-1])
    assert load_weights(out)[1:] == (World(), "sb3")


def test_a_second_signal_does_not_end_what_follows_the_first() -> None:
    before = signal.getsignal(signal.SIGTERM)
    hears = signal.signal(signal.SIGINT, signal.default_int_handler)  # nohup may ignore it
    with ended_by_signals() as stopped:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGUSR1)
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1):
            signal.raise_signal(number)
    assert stopped == [signal.SIGUSR1, signal.SIGTERM, signal.SIGINT, signal.SIGUSR1]
    assert signal.getsignal(signal.SIGTERM) == before
    signal.signal(signal.SIGINT, hears)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with ended_by_signals() as stopped:
            signal.raise_signal(signal.SIGHUP)
        assert stopped == []
    finally:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.mark.long
def test_a_whole_training_by_the_command_line_writes_weights(tmp_path: Path) -> None:
    out = tmp_path / "sb3.pt"
    assert main(["--steps", "5100", "--beacon", "--out", str(out)]) == 0
    assert load_weights(out)[1:] == (World(beacon=True), "sb3")
