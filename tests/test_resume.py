"""Interrupted is uninterrupted: a training that is cut and resumed ends with the same bytes."""

import json
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from pytest import CaptureFixture, MonkeyPatch

import deepflight
import dqn
from deepflight import Config, Run, load, main
from env import World, refly

KEYS = ["config", "fingerprint", "log", "validations", "actions", "seconds", "forests"]
KEYS += ["rng", "agent", "optimizer"]
SMALL = {"steps": 400, "learning_starts": 100, "replay_size": 200, "target_every": 120}
SMALL |= {"update_every": 16, "batch_size": 8}  # the replay wraps at step 200
WORDS = [x for key, n in SMALL.items() for x in (f"--{key.replace('_', '-')}", str(n))]


class Small(Config):
    """A training of seconds."""

    program: ClassVar[str] = f'"{__file__}"'
    validate_every: ClassVar[int] = 200


def shorten(patch: Callable) -> None:
    """Validate in two forests."""
    patch(deepflight, "VALIDATION", range(10**9, 10**9 + 2))


@pytest.fixture(scope="module", autouse=True)
def short() -> Iterator[None]:
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # nohup may ignore it
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch.setattr)
        yield
    signal.signal(signal.SIGINT, handler)


def go(folder: Path, cuts: set[int] = frozenset(), **changed: int) -> Run:
    """Train in this folder, with a real Ctrl-C at these steps; returns the last of the runs."""

    def train(c: Config, envs: object, *rest: object) -> Iterator[tuple]:
        for learner in dqn.train(c, envs, *rest):
            if envs.steps in cuts:
                signal.raise_signal(signal.SIGINT)
            yield learner

    folder.mkdir(exist_ok=True)
    c = type("Cut", (Small,), {"train": staticmethod(train)})(**SMALL | changed)
    run, codes = Run(c, folder), []
    while codes.append(run.go()) or codes[-1]:
        run = Run(c, folder, load(folder / "checkpoint.pt", *KEYS))
    assert codes == [130] * len(cuts) + [0]
    return run


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return go(tmp_path_factory.mktemp("whole") / "small")


def equal(a: object, b: object) -> bool:
    """The same numbers, texts and tensors, through and through, but for the clock."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a.keys() - {"seconds"})
    if isinstance(a, list):
        return len(a) == len(b) and all(map(equal, a, b))
    return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


def assert_same_training(a: Path, b: Path) -> None:
    """Two folders hold the same settings, weights, episodes, checkpoint and log."""
    for name in ("best.pt", "config.json", "validation.jsonl"):
        assert (a / name).read_bytes() == (b / name).read_bytes(), name
    logs = [(folder / "log.csv").read_text().splitlines() for folder in (a, b)]
    one, two = ([line.rpartition(",")[0] for line in log] for log in logs)
    assert one == two and len(one) == 3  # seconds are the last column
    assert equal(*(load(folder / "checkpoint.pt", *KEYS) for folder in (a, b)))


def test_ten_times_interrupted_is_uninterrupted(whole: Run, tmp_path: Path) -> None:
    cuts = {8, 48, 96, 104, 160, 200, 208, 320, 360, 392}  # some after the replay has wrapped
    cut = go(tmp_path / "small", cuts)
    assert_same_training(whole.folder, cut.folder)
    clock = [row["seconds"] for row in cut.log]
    assert clock == sorted(clock)  # the time of all sittings
    for name in ("frames", "actions", "rewards", "ends", "added"):
        assert np.array_equal(getattr(whole.replay, name), getattr(cut.replay, name)), name


def test_ctrl_c_and_a_kill_save_and_print_the_command_that_goes_on(
    whole: Run, tmp_path: Path, monkeypatch: MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(deepflight.__file__).parent))
    monkeypatch.chdir(tmp_path)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    command = [sys.executable, __file__, "train", *WORDS, "--name", "small"]
    for number in (signal.SIGINT, signal.SIGTERM):
        process = subprocess.Popen(command, **pipes)
        assert any("step  eps" in line for line in process.stdout), process.stderr.read()
        process.send_signal(number)
        *_, saved, line = process.communicate()[0].splitlines()
        assert (process.returncode, saved[:14]) == (128 + number, "saved at step ")
        command = shlex.split(line)
    assert command[:2] == [sys.executable, __file__] and main(command[2:], Small) == 0
    assert_same_training(whole.folder, Path("runs/small"))


def test_every_validation_episode_is_kept_and_can_be_flown_again(whole: Run) -> None:
    lines = (whole.folder / "validation.jsonl").read_text().splitlines()
    episodes = [json.loads(line) for line in lines]
    assert [(e.pop("step"), e["seed"] - 10**9) for e in episodes] == [
        (step, forest) for step in (200, 400) for forest in (0, 1)
    ]
    for episode in episodes:
        *_, drone = refly(episode, World())
        assert drone.episode() == episode


def test_a_finished_training_goes_on_when_it_gets_more_steps(whole: Run, tmp_path: Path) -> None:
    shutil.copytree(whole.folder, tmp_path / "more")
    assert main(["train", "--resume", str(tmp_path / "more"), "--steps", "480"], Small) == 0
    before, after = ((f / "log.csv").read_text() for f in (whole.folder, tmp_path / "more"))
    assert after.startswith(before) and after.count("\n") == before.count("\n") + 1
    saved = load(tmp_path / "more" / "checkpoint.pt", *KEYS)
    assert saved["config"]["steps"] == 480 and len(saved["actions"]) == 480 // 8
    assert saved["agent"]["averaged.n_averaged"] == 3  # updates of its own last tenth, from 433 on


def test_what_does_not_fit_a_checkpoint_is_refused(
    whole: Run, tmp_path: Path, capsys: CaptureFixture
) -> None:
    class Other(Small):
        pilot = "imitation"

    content = load(whole.folder / "checkpoint.pt", *KEYS)
    content["actions"][3:] = [bytes(8)] * 47  # all turn right, so other episodes end
    deepflight.save(tmp_path / "checkpoint.pt", content)
    before = {path: path.read_bytes() for path in whole.folder.iterdir()}
    for words, config, folder, named in (
        ("--threads 2 --steps 480", Small, whole.folder, "keeps its settings"),
        ("", Small, whole.folder, "has flown 400 steps"),
        ("--steps 200", Small, whole.folder, "has flown 400 steps"),
        ("--steps 480", Other, whole.folder, "was made by ['dqn'"),
        ("--steps 480", Small, tmp_path, "other episodes on this machine"),
    ):
        assert main(["train", "--resume", str(folder), *words.split()], config) == 2
        error = capsys.readouterr().err
        assert named in error and error.count("\n") == 1
    assert before == {path: path.read_bytes() for path in whole.folder.iterdir()}


def test_truncated_episodes_come_back_with_their_last_frames(
    tmp_path: Path, monkeypatch: MonkeyPatch
) -> None:
    monkeypatch.setattr(deepflight, "World", partial(World, max_steps=3))
    kept = go(tmp_path / "a", steps=160).replay.last_frames
    again = go(tmp_path / "b", {152}, steps=160).replay.last_frames
    assert kept.keys() == again.keys() and len(kept) == 8 * (160 // 8 // 3)
    assert all(np.array_equal(frame, again[key]) for key, frame in kept.items())


def test_a_loss_that_is_no_number_ends_a_training_and_the_last_good_weights_stay(
    tmp_path: Path, monkeypatch: MonkeyPatch, capsys: CaptureFixture
) -> None:
    def train(c: Config, envs: object, *rest: object) -> Iterator[tuple]:
        for agent, replay in dqn.train(c, envs, *rest):
            if envs.steps == 304:
                agent.q.head[2].bias.data[0] = torch.nan
            yield agent, replay

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Small, "train", staticmethod(train))
    assert main(["train", *WORDS, "--name", "small"], Small) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("deepflight.py: step 3") and line.endswith("the loss is nan")
    q, *_ = deepflight.load_weights("runs/small/best.pt")
    saved = load("runs/small/checkpoint.pt", *KEYS)
    assert len(saved["actions"]) == 200 // 8
    assert all(tensor.isfinite().all() for tensor in [*q.parameters(), *saved["agent"].values()])


if __name__ == "__main__":  # a script of its own, as lessons are
    shorten(setattr)
    sys.exit(main(config=Small))
