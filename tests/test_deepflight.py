"""The experiment: statistics, settings, files, the command line, and the shipped pilot."""

import json
import math
import os
import pickle
import pstats
import resource
import subprocess
import sys
import zipfile
from collections import namedtuple
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from pytest import CaptureFixture, MonkeyPatch, approx

import deepflight
import env
from deepflight import Config, load, load_weights, main, measure, save, save_weights, wilson
from dqn import InputError, QNetwork

ROOT = Path(deepflight.__file__).parent
FLOWN = {"progress": 10.0, "return": -1.0, "outcome": "crash"}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_wilsons_interval_ends_1_96_standard_errors_away() -> None:
    for hits, n in ((0, 10), (3, 20), (50, 100), (500, 500)):
        for end in (wilson(hits / n, n)["low"], wilson(hits / n, n)["high"]):
            if 1e-9 < end < 1 - 1e-9:
                assert abs(hits / n - end) == approx(1.96 * math.sqrt(end * (1 - end) / n))
    assert wilson(0.96, 100) == approx({"value": 0.96, "low": 0.9016, "high": 0.9843}, abs=1e-4)


def test_the_metrics_of_two_forests_by_hand() -> None:
    random = [FLOWN | {"steps": n} for n in (15, 35)]  # in forests A and B
    far = {"steps": 170, "progress": 90.0, "return": 9.0, "outcome": "far"}
    metrics = deepflight.summarize([FLOWN | {"steps": 30}, far], random)
    # Two forests drawn again are A twice, B twice or one of each: ratios 2, 34/7 and 4.
    assert metrics["longer"] == approx({"value": 3.0, "low": 1.0, "high": 27 / 7})
    assert metrics["steps"] == {"value": 100.0, "low": 30.0, "high": 170.0}
    assert deepflight.summarize(random, random)["crash"] == wilson(1.0, 2)
    table = measure([FLOWN | {"outcome": o, "steps": 1} for o in env.OUTCOMES])
    assert table["crossed"].tolist() == [o in ("goal", "far") for o in env.OUTCOMES]
    assert (np.array([table[o] for o in env.OUTCOMES]) == np.eye(6)).all()


def test_each_of_24_settings_refuses_what_is_below_and_above_its_range() -> None:
    numbers = [f for f in fields(Config) if f.type is not str]
    assert len(fields(Config)) == 24 == len(numbers) + 1  # the other is the camera
    for f in numbers:
        for wrong in (f.metadata["legal"][0] - 1, f.metadata["legal"][1] + 1, math.nan):
            with pytest.raises(InputError, match=f"{f.name} is"):
                Config(**{f.name: wrong})
    Config(replay_size=72, learning_starts=72)  # 8 environments, 5 steps and 4 rows
    for small in ({"replay_size": 71}, {"learning_starts": 71}):
        with pytest.raises(InputError, match="must be 72 or more"):
            Config(**small)


def test_the_shaped_reward_by_hand() -> None:
    moves = [(0.5, ""), (-0.5, ""), *((0.4, outcome) for outcome in env.OUTCOMES)]
    drones = [namedtuple("Moved", "forward outcome")(*move) for move in moves]
    r = np.array([0.75, 0.75, -10, 1.2, -10, -10, -10, 0.5])  # crash goal far back side time
    expected = [1.75, -0.25, -9.2, 2 + 0.99 * 125, -9.2 + 0.99 * 200, -9.2, -9.2, 1.3]
    assert deepflight.shaped_reward(r, drones, Config()) == approx(expected)
    plain = Config(forward_reward=0, goal_bonus=0, far_bonus=0)
    assert (deepflight.shaped_reward(r, drones, plain) == r).all()


def test_training_validation_and_test_forests_are_three_disjoint_ranges() -> None:
    assert min(deepflight.VALIDATION) >= deepflight.TRAIN_END
    assert max(deepflight.VALIDATION) < deepflight.TEST_FIRST
    assert deepflight.parse(["eval"], Config).first_seed == deepflight.TEST_FIRST


def test_a_damaged_file_is_refused_or_its_content_is_whole(tmp_path: Path) -> None:
    path, content = tmp_path / "a.pt", {"x": torch.arange(50.0), "step": 2**70}
    save(path, content)
    whole, refused, rng = path.read_bytes(), 0, np.random.default_rng(0)
    flips = [(place, int(rng.integers(1, 256))) for place in rng.integers(len(whole), size=300)]
    directory = range(zipfile.ZipFile(path).start_dir, len(whole))
    for place, bits in [*flips, *((place, 16) for place in directory)]:
        path.write_bytes(whole[:place] + bytes([whole[place] ^ bits]) + whole[place + 1 :])
        try:
            read = load(path, "x", "step")
            assert torch.equal(read["x"], content["x"]) and read["step"] == 2**70, (place, bits)
        except InputError:
            refused += 1
    assert refused > 400  # the rest are bytes that say nothing: padding and dates
    for length in range(0, len(whole), 40):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match="is damaged"):
            load(path, "x")


class Payload:
    """A pickle that runs code when it is loaded, as a malicious one would."""

    def __reduce__(self) -> tuple:
        return os.mkdir, ("trap",)


def test_what_we_did_not_write_is_refused_and_no_code_in_it_runs(here: Path) -> None:
    torch.save({"network": Payload(), "pilot": "dqn", "beacon": False, "camera": "grey"}, "bad.pt")
    torch.save({"weights": torch.zeros(3)}, "foreign.pt")
    Path("pickle.pt").write_bytes(pickle.dumps(Payload()))
    for name in ("bad.pt", "foreign.pt", "pickle.pt", "missing.pt", "."):
        with pytest.raises(InputError, match=name):
            load_weights(name)
    assert [path.suffix for path in here.iterdir()] == [".pt"] * 3
    pickle.loads(Path("pickle.pt").read_bytes())
    assert Path("trap").exists()  # where pickle is trusted it runs


def test_weights_come_back_in_half_precision_with_their_world_and_kind(tmp_path: Path) -> None:
    q, path = QNetwork(9), tmp_path / "w.pt"
    save_weights(path, q, Config(beacon=True, camera="disparity"))
    again, *rest = load_weights(path)
    assert rest == [env.World(beacon=True, camera="disparity"), "dqn"]
    assert all(map(torch.equal, again.parameters(), q.half().float().parameters()))


def test_on_a_full_disk_the_old_file_stays_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "a.pt").write_bytes(b"old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))  # no file may grow beyond
    try:
        for content in (bytes(20_000), {"x": torch.zeros(5_000)}):
            with pytest.raises(OSError, match="too large"):
                save(tmp_path / "a.pt", content)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("a.pt", b"old")]


BAD = "|fly|train now|train --batch-size many|train --gamma 1.5|train --gamma nan|train --steps 0"
BAD += "|train --camera colour|train --name taken|train --replay-size 10|train --resume nowhere"
BAD += "|train --resume text.pt|eval --episodes 0|eval --episodes few|eval --first-seed -1"
BAD += "|train --steps inf|train --seed nan|train --batch-size 2.5|eval --episodes 1e9"
BAD += "|train --steps 1/0|train --steps 1e999"
BAD += "|eval --weights nowhere.pt|eval --weights text.pt|eval --out text.pt|eval --json ."


@pytest.mark.usefixtures("here")
def test_a_bad_command_line_gets_one_line_and_exit_code_2(capsys: CaptureFixture) -> None:
    Path("runs/taken").mkdir(parents=True)
    Path("text.pt").write_text("no weights")
    for line in BAD.split("|"):
        try:
            code = main(line.split())
        except SystemExit as error:  # of argparse
            code = error.code
        out, error = capsys.readouterr()
        assert (code, out, error.count("\n"), error[:13]) == (2, "", 1, "deepflight.py"), line


@pytest.mark.parametrize("line", ["-h", "train -h", "eval -h"])
def test_help_shows_the_commands_and_a_row_per_flag(line: str, capsys: CaptureFixture) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(line.split())
    out = capsys.readouterr().out
    assert "python deepflight.py train --resume DIR     go on with" in out
    settings = [f for f in fields(Config) if line == "train -h"]
    rows = [row for row in out.splitlines() if "(default: " in row and row[:4] == "  --"]
    assert len(rows) >= len(settings)
    for f, row in zip(settings, rows, strict=False):
        assert f.name.replace("_", "-") in row and f"{f.metadata['help']} (def" in row


def test_without_torch_one_line_says_what_to_do() -> None:
    script = "import sys; sys.modules['torch'] = None; import deepflight"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1) and "README.md" in done.stderr


@pytest.mark.usefixtures("here")
def test_eval_prints_a_table_and_writes_json_and_a_film(capsys: CaptureFixture) -> None:
    assert main(["eval", "--episodes", "2", "--json", "out/r.json", "--out", "film"]) == 0
    out, error = capsys.readouterr()
    head, *rows, _, wrote = out.splitlines()[2:]
    assert (head.split(), len(rows)) == (["random", "straight", "dqn"], 6)
    assert error == "flying random\nflying straight\nflying dqn\n"
    assert wrote.startswith("wrote film/dqn.gif: forest 400000000")
    with Image.open("film/dqn.gif") as film:
        assert (film.info["duration"], film.info["loop"]) == (100, 0) and film.n_frames > 20
    pilots = json.loads(Path("out/r.json").read_text())["pilots"]
    assert [len(metrics["episodes"]) for metrics in pilots.values()] == [2, 2, 2]
    for episode in pilots["random"]["episodes"] + pilots["dqn"]["episodes"]:
        *_, drone = env.refly(episode, env.World())
        assert drone.episode() == episode
    assert min(episode["steps"] for episode in pilots["dqn"]["episodes"]) > 2.8 * 27  # [DF]'s claim
    assert f"{pilots['dqn']['steps']['value']:.0f} [" in rows[3]


WINDOWS = """
import sys, signal
del signal.SIGHUP, signal.SIGPIPE
import deepflight as d
d.VALIDATION = range(10**9, 10**9 + 2)
assert d.main("train --steps 8e1 --learning-starts 80".split()) == 0
assert d.main("eval --episodes 1 --weights runs/001".split()) == 0
"""


def test_under_a_profiler_and_without_what_windows_lacks_train_and_eval_work(here: Path) -> None:
    Path("windows.py").write_text(WINDOWS)
    words = [sys.executable, "-m", "cProfile", "-o", "profile", "windows.py"]
    path = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, env=path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "flying random\nflying straight\nflying dqn\n")
    assert (here / "runs/eval/001.gif").stat().st_size > 1000
    assert '"steps": 80,' in (here / "runs/001/config.json").read_text()
    assert {"train", "evaluate"} <= {name for _, _, name in pstats.Stats("profile").stats}
