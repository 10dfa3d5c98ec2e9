"""Trust: interrupted is uninterrupted, killed loses little, broken is not believed.

The quick half runs with all tests. The long half, the same lessons with real signals at many random
moments, runs by `python -m pytest -m long`.
"""

import hashlib
import io
import json
import math
import os
import pickle
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch

import deepflight
from deepflight import TEACHER, configure, train
from dqn import QNetwork, Replay, load, load_weights, lock_folder, save, save_weights
from env import Fleet, ForestEnv, World, fly, laser_pilot, teach

CHECKPOINT = "checkpoint.pt"
ROOT = Path(__file__).parent.parent
# A training small enough to be done many times: its replay wraps at step 400.
SMALL = dict(
    steps=800, learning_starts=200, replay_size=400, update_every=16, batch_size=8, test_every=400,
    threads=1,
)  # fmt: skip
FLAGS = [x for key, value in SMALL.items() for x in (f"--{key.replace('_', '-')}", str(value))]


def start(*words: object, folder: Path, **how: object) -> subprocess.Popen:
    """Start the real command line in a folder of its own."""
    line = [sys.executable, "-u", str(ROOT / "deepflight.py"), *map(str, words)]
    how = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | how
    for number in deepflight.STOPS:  # what the tests ignore, as under nohup, a child would too
        if signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    return subprocess.Popen(line, cwd=folder, **how)


def flies(process: subprocess.Popen) -> bool:
    """Wait until a training prints its table's head, and with it takes off."""
    return any("step  eps" in line for line in process.stdout)


def finish(*words: object, folder: Path, **how: object) -> tuple[int, str, str]:
    """Run the command line to its end: exit code, output, errors."""
    process = start(*words, folder=folder, **how)
    out, error = process.communicate()
    return process.returncode, out, error


class Watched(deepflight.Run):
    """A training that gets a real Ctrl-C at chosen steps, and can be looked at when it is over."""

    cuts: ClassVar[set[int]] = set()
    runs: ClassVar[list[deepflight.Run]] = []

    def note(self) -> None:
        """The step's bookkeeping, and then perhaps the signal."""
        super().note()
        if self.book["step"] in self.cuts:
            signal.raise_signal(signal.SIGINT)
        self.runs.append(self)


def train_with_cuts(
    folder: Path, cuts: set[int], demos: Sequence = (), **changed: object
) -> deepflight.Run:
    """Train SMALL in this folder, taken up again after every cut; returns the last run."""
    Watched.cuts, saved = cuts, None
    c, r = configure(SMALL | changed)
    for _ in range(len(cuts) + 1):
        train(c, r, folder, saved, demos)
        saved = load(folder / CHECKPOINT, "checkpoint")
    return Watched.runs[-1]


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Trainings in this process are watched, and test points are two forests."""
    monkeypatch.setattr(deepflight, "Run", Watched)
    monkeypatch.setattr(deepflight, "TESTS", range(10**9, 10**9 + 2))
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # nohup may ignore it
    yield
    signal.signal(signal.SIGINT, handler)
    Watched.runs.clear()
    Watched.cuts = set()


def assert_equal(a: object, b: object) -> None:
    """The same numbers, texts and tensors, through and through."""
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a.keys() - {"seconds", "log"}:  # the clock differs, and the log holds it
            assert_equal(a[key], b[key])
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_equal(x, y)
    elif isinstance(a, torch.Tensor):
        assert torch.equal(a, b)
    else:
        assert a == b


def assert_same_training(a: Path, b: Path) -> None:
    """Two run folders hold the same log, the same best weights and the same checkpoint."""
    for name in ("best.pt", "config.json"):
        assert (a / name).read_bytes() == (b / name).read_bytes(), name
    log, same = (
        [line.rpartition(",")[0] for line in (x / "log.csv").read_text().splitlines()]
        for x in (a, b)
    )
    assert log == same, "all but the seconds, which are the last column"
    assert_equal(load(a / CHECKPOINT, "checkpoint"), load(b / CHECKPOINT, "checkpoint"))


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small training that nothing disturbed."""
    folder = tmp_path_factory.mktemp("whole")
    code, _, error = finish("train", *FLAGS, "--name", "small", folder=folder)
    assert code == 0, error
    return folder / "runs/small"


# -------------------------------------------------- interrupted is uninterrupted


def test_ten_times_taken_up_again_is_never_interrupted(tmp_path: Path, watched: None) -> None:
    cuts = np.random.default_rng(0).choice(np.arange(1, 100), 8, replace=False) * 8
    cuts = {*cuts.tolist(), 408, 792}  # two after the replay has wrapped
    whole = train_with_cuts(tmp_path / "whole", set())
    cut = train_with_cuts(tmp_path / "cut", cuts)
    assert_same_training(tmp_path / "whole", tmp_path / "cut")
    for name in ("frames", "actions", "rewards", "ends", "added"):
        assert np.array_equal(getattr(whole.replay, name), getattr(cut.replay, name)), name


def test_with_a_teacher_demonstrations_and_disparity_too(tmp_path: Path, watched: None) -> None:
    flights = fly(laser_pilot(0.99), [0, 1], World(), blind=True)
    demos = [(f["seed"], f["actions"]) for f in flights]
    told = {"teacher": True, "demo_updates": 3, "steps": 480, "test_every": 160}
    told |= {"camera": "disparity", "demo_share": 0.25}
    whole = train_with_cuts(tmp_path / "whole", set(), demos, **told)
    cut = train_with_cuts(tmp_path / "cut", {8, 200, 408}, demos, **told)
    assert_same_training(tmp_path / "whole", tmp_path / "cut")
    assert np.array_equal(whole.replay.scores, cut.replay.scores)
    assert np.array_equal(whole.replay.frames, cut.replay.frames)
    assert (whole.replay.frames[:, :, 0] == 0).mean() > 0.5, "the sky has no disparity"
    assert whole.replay.scores.any(2).all()
    assert load(tmp_path / "cut" / CHECKPOINT, "checkpoint")["demos"] == demos
    first = (tmp_path / "whole/log.csv").read_text().splitlines()[1].split(",")
    assert (first[0], first[2]) == ("8", "3"), "tested after 3 updates, and before it flies alone"


def test_where_q_would_explore_the_teacher_flies(tmp_path: Path, watched: None) -> None:
    c, r = configure(TEACHER | SMALL | {"teacher": True, "epsilon_final": 1.0, "steps": 240})
    train(c, r, tmp_path)
    fleet, alone = Watched.runs[-1].fleet, Fleet(World(), 1, blind=True)
    for lane in (0, 1):
        seed, actions = fleet.records[lane][0]
        assert len(actions) == 240 // 8
        alone.reset([0], [seed])
        for a in actions:
            paid = r.forward_reward, r.goal_value, r.far_value
            assert teach(alone, c.gamma, *paid).argmax() == a
            alone.step([a])


def test_a_truncated_flight_comes_back_with_its_last_frame(
    tmp_path: Path, watched: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(deepflight, "World", partial(World, max_steps=3))
    c, r = configure(SMALL | {"learning_starts": 80, "steps": 160})
    train(c, r, tmp_path)
    kept = Watched.runs[-1].replay.last_frames
    assert kept
    c, r = configure(SMALL | {"learning_starts": 80, "steps": 168})
    train(c, r, tmp_path, load(tmp_path / CHECKPOINT, "checkpoint"))
    restored = Watched.runs[-1].replay.last_frames
    assert kept.keys() <= restored.keys()
    for key, frame in kept.items():
        assert np.array_equal(frame, restored[key])


def test_a_checkpoint_keeps_no_frames_but_a_byte_a_step_or_two(tmp_path: Path) -> None:
    fleet, replay, rng = Fleet(World(), 8), Replay(4000, 8), np.random.default_rng(0)
    sizes = []
    for step in range(500):
        fleet.reset(fleet.landed, rng.integers(10**9, size=len(fleet.landed)))
        fleet.step(rng.integers(9, size=8))
        if step + 1 in (100, 500):
            content = {"flights": fleet.record(replay.rows)}
            save(tmp_path / CHECKPOINT, "checkpoint", content)
            sizes.append((tmp_path / CHECKPOINT).stat().st_size)
    assert 3200 < sizes[1] - sizes[0] < 2.5 * 3200  # random flights are short: 27 steps and a seed


def test_ctrl_c_saves_and_prints_the_command_that_goes_on(
    uninterrupted: Path, tmp_path: Path
) -> None:
    process = start("train", *FLAGS, "--name", "small", folder=tmp_path)
    flies(process)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate()
    assert process.returncode == 130
    step = load(tmp_path / "runs/small" / CHECKPOINT, "checkpoint")["book"]["step"]
    assert step < SMALL["steps"]
    _, stopping, saved, command = error.splitlines()
    assert stopping == "stopping: this step ends and is saved; again: at once"
    assert saved == f"saved at step {step}; to go on:"
    done = subprocess.run(shlex.split(command), cwd="/", capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert_same_training(uninterrupted, tmp_path / "runs/small")


def test_whatever_is_in_a_folder_that_is_not_ours_stays(
    uninterrupted: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    for path in ("x" * 300, "nowhere", str(tmp_path)):
        assert deepflight.main(["train", "--resume", path]) == 2
    run, mine = tmp_path / "run", tmp_path / "mine.csv"
    mine.write_text("the data of years")
    others = {"log.csv": "step,episodes,updates,my_notes", "config.json": '{"steps": 5}'}
    torch.save({"kind": "mine", "weights": torch.ones(3)}, tmp_path / "theirs.pt")
    others = {name: text.encode() for name, text in others.items()}
    others["best.pt"] = (tmp_path / "theirs.pt").read_bytes()
    for name, data in others.items():
        shutil.copytree(uninterrupted, run, dirs_exist_ok=True)
        (run / name).write_bytes(data)
        assert deepflight.main(["train", "--resume", str(run), "--steps", "808"]) == 2
        assert "did not write it" in capsys.readouterr().err.splitlines()[-1]
        assert (run / name).read_bytes() == data
    shutil.copytree(uninterrupted, run, dirs_exist_ok=True)
    (run / ".thesis.part").write_text("chapter one")
    (run / ".log.csv.original.part").write_text("the data of years")
    (run / ".best.pt.0123abcd.part").mkdir()
    (run / ".best.pt.deadbeef.part").write_text("notes")
    half = (run / "checkpoint.pt").read_bytes()[:5000]
    (run / ".checkpoint.pt.a1b2c3d4.part").write_bytes(half)  # of a save that was killed
    (run / ".log.csv.00000000.part").touch()
    assert deepflight.main(["train", "--resume", str(run), "--steps", "808"]) == 0
    stay = {
        ".best.pt.0123abcd.part",
        ".best.pt.deadbeef.part",
        ".log.csv.original.part",
        ".thesis.part",
    }
    assert {path.name for path in run.glob(".*")} == stay
    (run / "log.csv").unlink()
    (run / "log.csv").symlink_to(mine)
    assert deepflight.main(["train", "--resume", str(run), "--steps", "808"]) == 2
    assert mine.read_text() == "the data of years"


def test_signals_at_the_very_end_are_no_traceback_and_no_sudden_death(tmp_path: Path) -> None:
    process = start("eval", "--episodes", 1, "--pilots", "random", folder=tmp_path)
    for line in process.stdout:
        while "flight.gif" in line and process.poll() is None:
            for number in deepflight.STOPS:
                process.send_signal(number)
    ends = {("", 0), *(("\ninterrupted\n", 128 + number) for number in deepflight.STOPS)}
    assert (process.stderr.read(), process.wait()) in ends, "main had returned, or had not"


def test_ctrl_c_held_down_is_no_traceback_and_leaves_nothing(tmp_path: Path) -> None:
    for words in (("train", *FLAGS, "--name", "small"), ("eval", "--episodes", 3)):
        process = start(*words, folder=tmp_path)
        while process.poll() is None:
            process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                process.wait(0.02)
        _, error = process.communicate()
        assert process.returncode in (130, -signal.SIGINT)
        assert "Traceback" not in error
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("number", deepflight.STOPS[1:])
def test_a_kill_and_a_closed_terminal_save_too(number: signal.Signals, tmp_path: Path) -> None:
    process = start("train", *FLAGS, "--steps", 10**6, "--name", "small", folder=tmp_path)
    flies(process)
    process.send_signal(number)
    _, error = process.communicate()
    assert process.returncode == 128 + number
    assert "to go on:" in error


def test_a_training_that_nobody_reads_goes_on_and_saves(tmp_path: Path) -> None:
    process = start("train", *FLAGS, "--name", "small", folder=tmp_path)
    flies(process)
    process.stdout.close()  # as `train | head` does
    assert (process.stderr.read(), process.wait()) == ("", 0)
    step = load(tmp_path / "runs/small" / CHECKPOINT, "checkpoint")["book"]["step"]
    assert step == SMALL["steps"]
    line = [sys.executable, str(ROOT / "deepflight.py"), "train", *FLAGS, "--name", "closed"]
    line += ["--steps", "400"]
    done = subprocess.run(["sh", "-c", f"exec {shlex.join(line)} >&-"], cwd=tmp_path, check=False)
    assert done.returncode == 0
    assert (tmp_path / "runs/closed/best.pt").exists()


def test_signals_are_given_back_and_a_thread_trains_without_them(
    tmp_path: Path, watched: None
) -> None:
    c, r = configure(SMALL)
    handlers = [signal.getsignal(number) for number in deepflight.STOPS]
    codes: list[int] = []
    worker = threading.Thread(target=lambda: codes.append(train(c, r, tmp_path / "a")))
    worker.start()
    worker.join()
    Watched.cuts = {400}
    codes.append(train(c, r, tmp_path / "b"))
    assert codes == [0, 130]
    assert handlers == [signal.getsignal(number) for number in deepflight.STOPS]


def test_a_second_ctrl_c_stops_at_once_and_the_checkpoint_stays_whole(tmp_path: Path) -> None:
    process = start("train", *FLAGS, "--test-every", 8, "--name", "small", folder=tmp_path)
    flies(process)  # and is then in its first test: a signal lets it end, a second does not
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            process.wait(0.05)
    _, error = process.communicate()
    assert process.returncode == 130
    assert error.splitlines()[-1].endswith("runs/small"), "the command that goes on"
    assert load(tmp_path / "runs/small" / CHECKPOINT, "checkpoint")["book"]["step"] in (0, 8)


def test_a_finished_training_goes_on_when_it_is_given_more_steps(
    uninterrupted: Path, tmp_path: Path
) -> None:
    run = tmp_path / "runs/small"
    shutil.copytree(uninterrupted, run)
    code, _, error = finish("train", "--resume", "runs/small", "--steps", "960", folder=tmp_path)
    assert code == 0, error
    before, after = ((f / "log.csv").read_text() for f in (uninterrupted, run))
    assert after.startswith(before)
    assert after.splitlines()[-1].startswith("960,")
    assert json.loads((run / "config.json").read_text())["steps"] == 960


# -------------------------------------------------- nothing broken is believed


def test_a_damaged_checkpoint_is_refused(uninterrupted: Path, tmp_path: Path) -> None:
    copy, rng = tmp_path / CHECKPOINT, np.random.default_rng(0)
    shutil.copy(uninterrupted / CHECKPOINT, copy)
    whole = copy.read_bytes()
    with copy.open("r+b") as file:
        for place in rng.integers(len(whole), size=100).tolist():
            for byte in (whole[place] ^ int(rng.integers(1, 256)), whole[place]):
                file.seek(place)
                file.write(bytes([byte]))
                file.flush()
                if byte != whole[place]:
                    with pytest.raises(ValueError, match="digest is wrong"):
                        load(copy, "checkpoint")
    load(copy, "checkpoint")


def test_what_does_not_fit_a_checkpoint_is_named(
    uninterrupted: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(uninterrupted.parent.parent)
    for flags, named in (
        ("--threads 2", "keeps its own settings: give none but --steps"),
        ("--lr 0.1 --batch-size 64", "keeps its own settings"),
        ("--preset mnih", "keeps its own settings"),
        ("--beacon", "keeps its own settings"),
        ("", "has flown 800 steps: give more"),
        ("--steps 400", "has flown 800 steps: give more"),
    ):
        assert deepflight.main(["train", "--resume", "runs/small", *flags.split()]) == 2
        error = capsys.readouterr().err
        assert named in error
        assert error.count("\n") == 1


def test_a_checkpoint_of_another_torch_or_other_flights_is_refused(
    uninterrupted: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    whole = load(uninterrupted / CHECKPOINT, "checkpoint")
    whole["book"]["step"] -= 8  # not yet done
    (seed, actions), *later = whole["flights"][0]
    for changed, named in (
        ({"machine": whole["machine"] | {"torch": "1.0"}}, "is of {'torch': '1.0'"),
        ({"flights": [[(seed + 1, actions), *later], *whole["flights"][1:]]}, "flown again here"),
    ):
        save(tmp_path / CHECKPOINT, "checkpoint", whole | changed)
        assert deepflight.main(["train", "--resume", str(tmp_path)]) == 2
        error = capsys.readouterr().err
        assert named in error
        assert error.count("\n") == 1


def test_a_folder_in_use_is_refused_until_its_owner_is_gone(
    uninterrupted: Path,
) -> None:
    hold = "import dqn, pathlib, sys; x = dqn.lock_folder(pathlib.Path(sys.argv[1]))"
    hold += "; x.__enter__(); print('held', flush=True); sys.stdin.read()"
    line, pipe = [sys.executable, "-c", hold, str(uninterrupted)], subprocess.PIPE
    with subprocess.Popen(line, cwd=ROOT, stdin=pipe, stdout=pipe, text=True) as owner:
        assert owner.stdout.readline() == "held\n"
        with pytest.raises(ValueError, match="another training's"), lock_folder(uninterrupted):
            pass
        owner.kill()
    with lock_folder(uninterrupted):  # a dead owner's lock is none
        pass


@pytest.mark.parametrize("room", [-100, -1_000_000])
def test_a_full_disk_is_one_line_and_the_old_checkpoint_stays(
    room: int, uninterrupted: Path, tmp_path: Path
) -> None:
    limit = (uninterrupted / CHECKPOINT).stat().st_size + room  # the first one is a little smaller

    def no_large_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    words = ("train", *FLAGS, "--name", "small")
    code, _, error = finish(*words, folder=tmp_path, preexec_fn=no_large_files)
    assert code == 1
    trouble, *go_on = error.splitlines()
    assert "too large" in trouble
    if room == -100:
        assert not list(tmp_path.rglob("*.part"))
        assert go_on[-1].endswith("--resume " + str(tmp_path / "runs/small"))
        step = load(tmp_path / "runs/small" / CHECKPOINT, "checkpoint")["book"]["step"]
        assert step < SMALL["steps"]
    else:
        assert not go_on
        assert not list(tmp_path.iterdir()), "where nothing could be saved, nothing is left"


def test_a_loss_that_is_no_number_stops_the_run_and_names_the_cause(
    tmp_path: Path, watched: None
) -> None:
    c, r = configure(SMALL)
    named = r"the loss is (nan|inf) at step 2.*: is lr too high\? Last good: .*checkpoint.pt"
    with pytest.raises(FloatingPointError, match=named):
        train(replace(c, lr=1e30), r, tmp_path)  # beyond what the command line allows
    saved = load(tmp_path / CHECKPOINT, "checkpoint")
    weights = [x for name, x in saved["agent"].items() if "extra" not in name]
    assert all(x.isfinite().all() for x in weights)


def test_weights_that_are_no_numbers_are_not_written(tmp_path: Path) -> None:
    q = QNetwork(9)
    q.head[2].bias.data[0] = 1e5  # more than half precision can hold
    with pytest.raises(FloatingPointError, match="no finite numbers"):
        save_weights(tmp_path / "best.pt", q)
    assert not list(tmp_path.iterdir())


def test_a_malicious_checkpoint_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    class Payload:
        def __reduce__(self) -> tuple:
            return os.mkdir, (str(tmp_path / "trap"),)

    monkeypatch.chdir(tmp_path)
    content = {"kind": "checkpoint", "settings": Payload()}
    torch.save(content, CHECKPOINT)
    archive = Path(CHECKPOINT).read_bytes()
    signed = archive + hashlib.sha256(archive).digest()
    for data in (pickle.dumps(content), archive, signed):
        Path(CHECKPOINT).write_bytes(data)
        for words in (["train", "--resume", "."], ["eval", "--weights", CHECKPOINT]):
            assert deepflight.main(words) == 2
            assert capsys.readouterr().err.count("\n") == 1
            assert not Path("trap").exists()
    with pytest.raises(FileExistsError):
        pickle.loads(pickle.dumps([Payload(), Payload()]))  # where pickle is trusted it runs


# -------------------------------------------------- what an attacker signs


with warnings.catch_warnings(action="ignore"):  # torch's, that these are in a prototype stage
    NESTED = torch.nested.nested_tensor([torch.zeros(2)] * 2)


def odd_attributes() -> object:
    """A dictionary whose own `keys` hides the method: torch.load keeps such attributes."""
    odd = OrderedDict()
    odd.__dict__["keys"] = 5
    return odd


def odd_thing(rng: np.random.Generator) -> object:
    """Something that no file of ours holds where it will stand."""
    size = rng.integers(0, 4, size=rng.integers(0, 4)).tolist()
    things = [
        *(None, True, -1, 2**200, 0.5, math.nan, math.inf, "x", b"x", [], {}, (), [[[]]], {1: "x"}),
        *(OrderedDict(), odd_attributes()),
        *(torch.zeros(size), torch.full(size, math.nan), torch.zeros(3136, 512).to_sparse()),
        *(torch.zeros(size, dtype=x) for x in (torch.int8, torch.float16, torch.complex64)),
        *(torch.zeros(1).expand(512, 3136), NESTED),
    ]
    return things[rng.integers(len(things))]


def spoil(thing: object, rng: np.random.Generator) -> object:
    """The same thing, one place in it changed, dropped or added, at any depth."""
    if not isinstance(thing, dict | list | tuple) or not thing or rng.random() < 0.1:
        return odd_thing(rng)
    pairs = dict(thing if isinstance(thing, dict) else enumerate(thing))
    key, way = list(pairs)[rng.integers(len(pairs))], rng.random()
    if way < 0.1:
        del pairs[key]
    elif way < 0.2:
        pairs["odd"] = odd_thing(rng)
    else:
        pairs[key] = spoil(pairs[key], rng)
    return pairs if isinstance(thing, dict) else type(thing)(pairs.values())


def weights_are_refused_or_the_same(path: Path, q: QNetwork, trials: int) -> None:
    """Write spoilt weights; what is not refused in one line has every weight as it was."""
    rng = np.random.default_rng(trials)
    for _ in range(trials):
        content = {"network": {k: x.half() for k, x in q.state_dict().items()}}
        content |= {"beacon": False, "camera": "grey"}
        content = spoil({"kind": "weights"} | content, rng)
        buffer = io.BytesIO()
        torch.save(content, buffer)
        path.write_bytes(buffer.getvalue() + hashlib.sha256(buffer.getvalue()).digest())
        try:
            read = load_weights(path, 9, beacon=False, camera="grey").state_dict()
        except ValueError as error:
            assert "\n" not in str(error)
            continue
        assert all(torch.equal(x.half().float(), read[k]) for k, x in q.state_dict().items())


def checkpoints_are_refused_or_fly(
    whole: Path, folder: Path, trials: int, capsys: pytest.CaptureFixture
) -> None:
    """Write spoilt checkpoints and go on with them: refused in one line, or flown to the end."""
    rng, content = np.random.default_rng(trials), load(whole / CHECKPOINT, "checkpoint")
    for _ in range(trials):
        shutil.copytree(whole, folder, dirs_exist_ok=True)
        spoilt = spoil(content, rng)
        save(folder / CHECKPOINT, "checkpoint", spoilt if type(spoilt) is dict else {})
        before = {path: path.read_bytes() for path in folder.iterdir()}
        code = deepflight.main(["train", "--resume", str(folder), "--steps", "808"])
        error = capsys.readouterr().err
        assert (code, error.count("\n")) in ((2, 1), (0, 0)), error
        if code == 2:
            assert before == {path: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("trials", [60, pytest.param(1500, marks=pytest.mark.long)])
def test_signed_weights_of_whatever_content_are_refused_or_the_same(
    trials: int, tmp_path: Path
) -> None:
    weights_are_refused_or_the_same(tmp_path / "w.pt", QNetwork(9), trials)


@pytest.mark.parametrize("trials", [12, pytest.param(500, marks=pytest.mark.long)])
def test_signed_checkpoints_of_whatever_content_are_refused_or_fly(
    trials: int,
    uninterrupted: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture,
    watched: None,
) -> None:
    checkpoints_are_refused_or_fly(uninterrupted, tmp_path / "spoilt", trials, capsys)


# -------------------------------------------------- the long half


@pytest.mark.long
def test_interrupted_at_ten_random_moments_is_uninterrupted(
    uninterrupted: Path, tmp_path: Path
) -> None:
    process = start("train", *FLAGS, "--name", "whole", folder=tmp_path)
    flies(process)
    began = time.perf_counter()
    process.communicate()
    whole = time.perf_counter() - began  # s, on a machine as busy as this one
    rng, steps, names = np.random.default_rng(), [], (f"cut{i}" for i in count())
    while len(steps) < 10 or sum(step > SMALL["replay_size"] for step in steps) < 2:
        name = next(names)
        process = start("train", *FLAGS, "--name", name, folder=tmp_path)
        flies(process)
        try:
            process.wait(rng.uniform(0, whole))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
        process.communicate()
        step = load(tmp_path / "runs" / name / CHECKPOINT, "checkpoint")["book"]["step"]
        if step == SMALL["steps"]:
            continue  # it was done already
        steps.append(step)
        code, _, error = finish("train", "--resume", f"runs/{name}", folder=tmp_path)
        assert code == 0, error
        assert_same_training(uninterrupted, tmp_path / "runs" / name)
    print(f"interrupted at steps {sorted(steps)}")


@pytest.mark.long
def test_killed_at_thirty_random_moments_it_always_goes_on(tmp_path: Path) -> None:
    words = [*FLAGS, "--steps", "100000", "--test-every", "16"]
    process = start("train", *words, "--name", "small", folder=tmp_path)
    rng, path = np.random.default_rng(), tmp_path / "runs/small" / CHECKPOINT
    kills = inside = 0
    flies(process)
    process.stdout.readline()  # the first row of the log
    while kills < 30 or (not inside and kills < 150):  # one at least shall hit a save
        kills += 1
        try:
            process.wait(rng.uniform(0, 4))
        except subprocess.TimeoutExpired:
            process.kill()
        process.communicate()
        inside += len(list(path.parent.glob(f".{path.name}.*.part")))
        step = load(path, "checkpoint")["book"]["step"]
        flown = int((path.parent / "log.csv").read_text().splitlines()[-1].split(",")[0])
        assert flown - step in (0, 16), "at most one interval is lost"
        process = start("train", "--resume", "runs/small", folder=tmp_path)
        assert flies(process), process.stderr.read()
    process.kill()
    process.communicate()
    print(f"killed {kills} times, {inside} inside a save; at step {step:,} in the end")
    assert inside


@pytest.mark.long
def test_a_million_steps_neither_leak_nor_go_wrong() -> None:
    env, rng, sizes = ForestEnv(), np.random.default_rng(0), []
    env.reset(seed=0)
    for step in range(1_000_000):
        observation, r, terminated, truncated, _ = env.step(int(rng.integers(9)))
        assert observation.shape == (4, 84, 84)
        assert observation.dtype == np.uint8
        assert -10 <= r <= 1.25
        if terminated or truncated:
            env.reset()
        if step >= 100_000 and step % 10_000 == 0:
            sizes.append(int(Path("/proc/self/statm").read_text().split()[1]))
    print(f"resident memory: {min(sizes) / sizes[0]:.4f} to {max(sizes) / sizes[0]:.4f} of itself")
    assert max(sizes) < 1.02 * sizes[0]
    assert min(sizes) > 0.98 * sizes[0]
