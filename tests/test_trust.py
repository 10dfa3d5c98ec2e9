"""Trust: interrupted is uninterrupted, killed loses little, broken is not believed.

The quick half runs with all tests. The long half, the same lessons with real signals at many random
moments, runs by `python -m pytest -m long`.
"""

import hashlib
import json
import os
import pickle
import resource
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import deepflight
from deepflight import CHECKPOINT, Config, Training, times_due
from dqn import load, save
from env import ForestEnv, World

ROOT = Path(__file__).parent.parent
# A training small enough to be done many times: its replay wraps at step 400.
SMALL = dict(
    steps=800, warmup=200, replay=400, update_every=16, batch=8, test_every=400, test_forests=2,
    threads=1, checkpoint_every=40,
)  # fmt: skip
FLAGS = [x for key, value in SMALL.items() for x in (f"--{key.replace('_', '-')}", str(value))]


def start(*words: object, folder: Path, **how: object) -> subprocess.Popen:
    """Start the real command line in a folder of its own."""
    line = [sys.executable, "-u", str(ROOT / "deepflight.py"), *map(str, words)]
    pipe = subprocess.PIPE
    return subprocess.Popen(line, cwd=folder, stdout=pipe, stderr=pipe, text=True, **how)


def flies(process: subprocess.Popen) -> bool:
    """Wait until a training prints its table's head, and with it takes off."""
    return any("steps/s" in line for line in process.stdout)


def finish(*words: object, folder: Path, **how: object) -> tuple[int, str, str]:
    """Run the command line to its end: exit code, output, errors."""
    process = start(*words, folder=folder, **how)
    out, error = process.communicate()
    return process.returncode, out, error


def begin(run: Training) -> None:
    """Take off, with a made-up bar for the random pilot, for that takes seconds to measure."""
    run.book["bar"] = 28.0
    run.begin()


def fly_until(run: Training, stop: int) -> None:
    """What deepflight.train does, without its clock, up to a step."""
    while run.book["step"] < stop:
        row = run.step()
        if times_due(row["step"], run.c.lanes, run.c.test_every):
            run.test(row)


def assert_equal(a: object, b: object) -> None:
    """The same numbers, texts and tensors, through and through."""
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a.keys() - {"seconds", "timing"}:  # the clock is the one thing that differs
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
    for name in ("log.csv", "best.pt", "config.json"):
        assert (a / name).read_bytes() == (b / name).read_bytes(), name
    assert_equal(load(a / CHECKPOINT, "checkpoint"), load(b / CHECKPOINT, "checkpoint"))


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small training that nothing disturbed."""
    folder = tmp_path_factory.mktemp("whole")
    code, _, error = finish("train", *FLAGS, "--name", "small", folder=folder)
    assert code == 0, error
    return folder / "runs/small"


# -------------------------------------------------- interrupted is uninterrupted


def test_ten_times_taken_up_again_is_never_interrupted(tmp_path: Path) -> None:
    c = Config(**SMALL)
    cuts = np.random.default_rng(0).choice(np.arange(1, c.steps // c.lanes), 8, replace=False)
    cuts = sorted([*(cuts * c.lanes).tolist(), 408, 792])  # two after the replay has wrapped
    runs = []
    for name, stops in (("whole", []), ("cut", cuts)):
        folder = tmp_path / name
        folder.mkdir()
        run = Training(c, folder)
        begin(run)
        for stop in stops:
            fly_until(run, stop)
            run.save()
            run = Training(c, folder)
            run.restore(load(folder / CHECKPOINT, "checkpoint"))
        fly_until(run, c.steps)
        run.save()
        (folder / "config.json").touch()
        runs.append(run)
    assert_same_training(tmp_path / "whole", tmp_path / "cut")
    for name in ("frames", "actions", "rewards", "ends", "added"):
        assert np.array_equal(*(getattr(run.memory, name) for run in runs)), name


def test_a_truncated_flight_comes_back_with_its_last_frame(tmp_path: Path) -> None:
    runs = [Training(Config(**SMALL), tmp_path) for _ in range(2)]
    for run in runs:
        run.world = World(max_steps=3)
        run.envs = [ForestEnv(run.world) for _ in run.envs]
    begin(runs[0])
    fly_until(runs[0], 160)
    runs[0].save()
    runs[1].restore(load(tmp_path / CHECKPOINT, "checkpoint"))
    kept, restored = (run.memory.last_frames for run in runs)
    assert kept
    assert kept.keys() == restored.keys()
    for key, frame in kept.items():
        assert np.array_equal(frame, restored[key])


def test_a_checkpoint_keeps_no_frames_but_a_byte_a_step_or_two(tmp_path: Path) -> None:
    c, sizes = Config(**SMALL | {"steps": 4000, "replay": 4000, "update_every": 200}), []
    run = Training(c, tmp_path)
    begin(run)
    for stop in (800, 4000):
        fly_until(run, stop)
        run.book["log"].clear()
        run.book["recent"].clear()
        run.save()
        sizes.append((tmp_path / CHECKPOINT).stat().st_size)
    assert sizes[0] < 27.1e6
    assert 3200 < sizes[1] - sizes[0] < 2.5 * 3200  # random flights are short: 27 steps and a seed


def test_ctrl_c_saves_and_prints_the_command_that_goes_on(
    uninterrupted: Path, tmp_path: Path
) -> None:
    process = start("train", *FLAGS, "--name", "small", folder=tmp_path)
    flies(process)
    process.send_signal(signal.SIGINT)
    out, error = process.communicate()
    assert (process.returncode, error) == (130, "")
    step = load(tmp_path / "runs/small" / CHECKPOINT, "checkpoint")["book"]["step"]
    assert step < SMALL["steps"]
    saved, command = out.splitlines()[-2:]
    assert saved == f"saved at step {step}; to go on:"
    done = subprocess.run(shlex.split(command), cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert_same_training(uninterrupted, tmp_path / "runs/small")


def test_sigterm_saves_too(tmp_path: Path) -> None:
    process = start("train", *FLAGS, "--steps", 10**6, "--name", "small", folder=tmp_path)
    flies(process)
    process.terminate()
    out, error = process.communicate()
    assert (process.returncode, error) == (143, "")
    assert "to go on:" in out


def test_a_second_ctrl_c_stops_at_once_and_the_checkpoint_stays_whole(tmp_path: Path) -> None:
    long_tests = ("--test-every", 8, "--test-forests", 1000, "--name", "small")
    process = start("train", *FLAGS, *long_tests, folder=tmp_path)
    flies(process)
    for _ in range(2):
        with pytest.raises(subprocess.TimeoutExpired):  # it is within its first test
            process.wait(1)
        process.send_signal(signal.SIGINT)
    _, error = process.communicate()
    assert process.returncode == 130
    assert error == "\ninterrupted\n"
    assert load(tmp_path / "runs/small" / CHECKPOINT, "checkpoint")["book"]["step"] == 0


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


def test_a_damaged_checkpoint_is_refused(tmp_path: Path) -> None:
    begin(Training(Config(**SMALL), tmp_path))
    copy, rng = tmp_path / CHECKPOINT, np.random.default_rng(0)
    whole = copy.read_bytes()
    with copy.open("r+b") as file:
        for place in rng.integers(len(whole), size=300).tolist():
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
        ("--threads 2", "threads 2, was 1"),
        ("--lr 0.1 --batch 64", "batch 64, was 8, lr 0.1, was 0.00025"),
        ("--preset mnih", "optimizer rmsprop, was adam"),
        ("--beacon", "beacon True, was False"),
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
        ({"config": whole["config"] | {"torch": "1.0"}}, "torch is 1.0, allowed"),
        ({"config": {k: v for k, v in whole["config"].items() if k != "n"}}, "n 5, was None"),
        ({"flights": [[(seed + 1, actions), *later], *whole["flights"][1:]]}, "fly otherwise"),
    ):
        save(tmp_path / CHECKPOINT, "checkpoint", whole | changed)
        assert deepflight.main(["train", "--resume", str(tmp_path)]) == 2
        error = capsys.readouterr().err
        assert named in error
        assert error.count("\n") == 1


def test_a_folder_in_use_is_refused_until_its_owner_is_gone(
    uninterrupted: Path,
) -> None:
    hold = "import deepflight, pathlib, sys; x = deepflight.lock_folder(pathlib.Path(sys.argv[1]))"
    hold += "; print('held', flush=True); sys.stdin.read()"
    line, pipe = [sys.executable, "-c", hold, str(uninterrupted)], subprocess.PIPE
    with subprocess.Popen(line, cwd=ROOT, stdin=pipe, stdout=pipe, text=True) as owner:
        assert owner.stdout.readline() == "held\n"
        with pytest.raises(ValueError, match="another training's"):
            deepflight.lock_folder(uninterrupted)
        owner.kill()
    deepflight.lock_folder(uninterrupted).close()  # a dead owner's lock is none


def test_a_full_disk_is_one_line_and_the_old_checkpoint_stays(tmp_path: Path) -> None:
    def no_large_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (30_000_000, 30_000_000))

    # RMSprop's state makes the first full checkpoint larger than the empty one.
    words = ("train", *FLAGS, "--optimizer", "rmsprop", "--name", "small")
    code, _, error = finish(*words, folder=tmp_path, preexec_fn=no_large_files)
    assert code == 1
    assert error.count("\n") == 1
    assert "too large" in error
    folder = tmp_path / "runs/small"
    assert load(folder / CHECKPOINT, "checkpoint")["book"]["step"] < SMALL["steps"]
    assert not list(folder.glob("*.part"))


def test_a_loss_that_is_no_number_stops_the_run_and_names_the_cause(tmp_path: Path) -> None:
    # Its first update falls on the step of a test point: not even best.pt may come of it.
    words = ("--optimizer", "rmsprop", "--optimizer-eps", 0, "--lr", 1, "--test-every", 208)
    code, _, error = finish("train", *FLAGS, *words, "--name", "small", folder=tmp_path)
    assert code == 1
    assert error.count("\n") == 1
    for part in ("loss, weights: nan at step 2", "learning rate", "runs/small/checkpoint.pt"):
        assert part in error
    saved = load(tmp_path / "runs/small" / CHECKPOINT, "checkpoint")
    assert all(x.isfinite().all() for x in saved["agent"].values())
    assert not (tmp_path / "runs/small/best.pt").exists()


def test_a_malicious_checkpoint_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    class Payload:
        def __reduce__(self) -> tuple:
            return os.mkdir, (str(tmp_path / "trap"),)

    monkeypatch.chdir(tmp_path)
    content = {"kind": "checkpoint", "config": Payload()}
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


# -------------------------------------------------- the long half


@pytest.mark.long
def test_interrupted_at_ten_random_moments_is_uninterrupted(
    uninterrupted: Path, tmp_path: Path
) -> None:
    rng, steps = np.random.default_rng(), []
    while len(steps) < 10 or sum(step > SMALL["replay"] for step in steps) < 2:
        name = f"cut{len(steps)}"
        process = start("train", *FLAGS, "--name", name, folder=tmp_path)
        flies(process)
        try:
            process.wait(rng.uniform(0, 3))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
        process.communicate()
        if process.returncode == 0:
            continue  # it was done already
        steps.append(load(tmp_path / "runs" / name / CHECKPOINT, "checkpoint")["book"]["step"])
        assert finish("train", "--resume", f"runs/{name}", folder=tmp_path)[0] == 0
        assert_same_training(uninterrupted, tmp_path / "runs" / name)
    print(f"interrupted at steps {sorted(steps)}")


@pytest.mark.long
def test_killed_at_thirty_random_moments_it_always_goes_on(tmp_path: Path) -> None:
    words = [*FLAGS, "--steps", "100000", "--checkpoint-every", "16", "--test-every", "16"]
    process = start("train", *words, "--name", "small", folder=tmp_path)
    rng, path, inside = np.random.default_rng(), tmp_path / "runs/small" / CHECKPOINT, 0
    flies(process)
    process.stdout.readline()  # the first row of the log
    for _ in range(30):
        try:
            process.wait(rng.uniform(0, 4))
        except subprocess.TimeoutExpired:
            process.kill()
        process.communicate()
        inside += path.with_name(path.name + ".part").exists()
        step = load(path, "checkpoint")["book"]["step"]
        flown = int((path.parent / "log.csv").read_text().splitlines()[-1].split(",")[0])
        assert flown - step in (0, 16), "at most one interval is lost"
        process = start("train", "--resume", "runs/small", folder=tmp_path)
        assert flies(process), process.stderr.read()
    process.kill()
    process.communicate()
    print(f"killed 30 times, {inside} inside a save; at step {step:,} in the end")
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
