"""The experiment: statistics, settings, both commands, and whether the shipped pilot can fly."""

import csv
import json
import math
import os
import pickle
import re
import subprocess
import sys
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
import pytest
import torch

import deepflight
from deepflight import (
    BEACON,
    DQN,
    MNIH,
    RunConfig,
    configure,
    learner_reward,
    summarize,
    wilson,
)
from dqn import DQNConfig, QNetwork, load, load_weights, save, save_weights
from env import OUTCOMES, Fleet, World, fly, laser_pilot, refly, straight_pilot

ROOT = Path(__file__).parent.parent
WORLD = World()


def command(*words: object, folder: Path) -> subprocess.CompletedProcess:
    """Run the real command line in a folder of its own."""
    line = [sys.executable, str(ROOT / "deepflight.py"), *map(str, words)]
    return subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False)


# -------------------------------------------------- statistics


def test_wilson_is_the_interval_whose_ends_are_1_96_standard_errors_away() -> None:
    for hits, n in ((0, 10), (3, 20), (50, 100), (500, 500)):
        figure = wilson(hits / n, n)
        for end in (figure["low"], figure["high"]):
            if 1e-9 < end < 1 - 1e-9:
                z = (hits / n - end) / math.sqrt(end * (1 - end) / n)
                assert abs(z) == pytest.approx(1.96)


def test_the_bootstrap_finds_the_normal_interval_of_a_mean() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(10, 3, 400)
    figure = deepflight.interval(x.mean(), x[rng.integers(400, size=(2000, 400))].mean(1))
    assert figure["high"] - figure["low"] == pytest.approx(2 * 1.96 * x.std() / 20, rel=0.1)


def test_the_figures_of_two_forests_by_hand() -> None:
    ended = {"progress": 10.0, "return": -1.0, "outcome": "crash", "edge": ""}
    bar = [ended | {"steps": n} for n in (10, 30, 20, 40)]  # forests A, B, A, B: 15 and 35 steps
    far = {"progress": 90.0, "return": 9.0, "outcome": "left", "edge": "far"}
    flights = [ended | {"steps": 30}, far | {"steps": 170}]
    draws = np.random.default_rng(0).integers(2, size=(2000, 2))
    figures = summarize(flights, bar, draws)
    # Resampling two forests gives A twice, B twice or one of each: ratios 2, 34/7 and 4.
    assert figures["over_random"] == pytest.approx({"value": 3.0, "low": 1.0, "high": 27 / 7})
    assert figures["steps"] == {"value": 100.0, "low": 30.0, "high": 170.0}
    shares = {key: figures[key]["value"] for key in ("crossed", "crash", "left", "goal", "time")}
    assert shares == {"crossed": 0.5, "crash": 0.5, "left": 0.5, "goal": 0.0, "time": 0.0}
    same = summarize(bar, bar, draws)
    assert same["over_random"] == {"value": 0.0, "low": 0.0, "high": 0.0}
    assert same["crash"] == wilson(1.0, 2), "four flights through two forests are two, not four"


def test_one_forest_has_no_interval(capsys: pytest.CaptureFixture) -> None:
    flight = {"steps": 10, "progress": 10.0, "return": -1.0, "outcome": "crash", "edge": ""}
    figures = summarize([flight], [flight], np.zeros((2000, 1), int))
    assert figures["crash"] == {"value": 1.0}
    deepflight.print_table({"straight": figures})
    assert "[" not in capsys.readouterr().out


@pytest.mark.parametrize("columns", [80, 60, 29])
def test_the_table_and_the_log_are_no_wider_than_the_terminal(
    columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    widest = dict.fromkeys(("value", "low", "high"), -1.0)
    names = ("random", "straight", "laser", "dqn")
    deepflight.print_table({name: dict.fromkeys(deepflight.ROWS, widest) for name in names})
    table = capsys.readouterr().out
    assert all(name in table for name in names)
    cells = dict.fromkeys(("step", "epsilon", "speed", "eta", "train_return"), 999.0)
    cells |= dict.fromkeys(("test_return", "test_over_random", "test_crossed", "test_crash"), 1.0)
    cells |= {"step": 1_400_000, "epsilon": 1.0, "test_over_random": 10.0}
    row = deepflight.ROW.format(**cells)
    assert len(row) == len(deepflight.HEAD) <= 60
    assert max(map(len, table.splitlines())) <= columns


# -------------------------------------------------- settings


def test_the_mnih_preset_is_extended_data_table_1() -> None:
    c, r = configure(MNIH)
    assert (c.steps, c.replay_size, c.learning_starts) == (1_400_000, 1_000_000, 50_000)
    assert (c.batch_size, c.epsilon_final, c.epsilon_decay) == (32, 0.1, 1_000_000)
    assert (c.update_every, c.target_every, c.gamma, c.lr) == (4, 10_000 // 4, 0.99, 2.5e-4)
    assert (r.forward_reward, r.goal_value, r.far_value) == (0, 0, 0)


def test_the_help_says_what_is_allowed_and_what_a_preset_changes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    for command in ("train", "eval"):
        with pytest.raises(SystemExit) as stop:
            deepflight.main([command, "--help"])
        assert stop.value.code == 0
    text = capsys.readouterr().out
    assert "control steps in all (1 to 1e+09; default 200000; mnih 1400000; beacon 400000)" in text
    assert "(-1e+06 to 1e+06; default 200.0; dqn 0.0; mnih 0.0; teacher 115.0; beacon 50.0)" in text
    assert "(true or false; default True; dqn False; mnih False)" in text
    assert "default: 2000000000" in text


def test_every_piece_that_is_not_in_the_textbook_has_one_setting_that_switches_it_off() -> None:
    extras = {f.name: f for kind in (DQNConfig, RunConfig) for f in fields(kind)}
    extras = {name: f for name, f in extras.items() if f.metadata["help"].startswith("[+]")}
    source = "".join((ROOT / name).read_text() for name in ("deepflight.py", "dqn.py"))
    for name in extras:
        assert f"[+{name}]" in source, f"{name} is marked where it happens"
    off = DQN | dict(adam=False, num_envs=1, bfloat16=False, teacher=False)
    assert extras.keys() == off.keys()
    configure(off)  # all of them at once are a legal training: plain DQN


def test_there_are_32_settings_and_each_is_a_flag(capsys: pytest.CaptureFixture) -> None:
    settings = [f.name for f in deepflight.SETTINGS]
    assert len(settings) == len({*settings}) == 32
    with pytest.raises(SystemExit):
        deepflight.parse(["train", "--help"])
    text = capsys.readouterr().out
    for name in settings:
        assert f"\n  --{name.replace('_', '-')} " in text or f"\n  --{name}, " in text, name


def test_where_the_beacon_shows_the_goal_nothing_else_is_worth_as_much() -> None:
    _, r = configure(BEACON)
    assert (r.goal_value, r.far_value, r.forward_reward) == (125, 50, 0)
    assert (RunConfig.goal_value, RunConfig.far_value, RunConfig.forward_reward) == (125, 200, 2)


def test_what_the_learner_is_paid_by_hand() -> None:
    c, infos = RunConfig(), [{"forward": x, "outcome": "", "edge": ""} for x in (0.5, -0.5)]
    infos += [{"forward": 0.4, "outcome": end, "edge": ""} for end in ("goal", "crash", "time")]
    infos += [{"forward": 0.4, "outcome": "left", "edge": edge} for edge in ("far", "side", "back")]
    r = np.array([0.75, 0.75, 1.2, -10, 0.5, -10, -10, -10])
    paid = [1.75, -0.25, 1.2 + 0.8 + 0.99 * 125, -9.2, 1.3, -9.2 + 0.99 * 200, -9.2, -9.2]
    assert learner_reward(r, infos, c, 0.99) == pytest.approx(paid)
    plain = RunConfig(forward_reward=0.0, goal_value=0.0, far_value=0.0)
    assert (learner_reward(r, infos, plain, 0.99) == r).all()


def test_a_metre_ahead_is_paid_to_the_learner_and_not_in_the_report() -> None:
    fleet, paid = Fleet(WORLD, 1, blind=True), []
    fleet.reset([0], [0])
    for a in (4, 8, 8, 8, 0):
        _, r, _, _, infos = fleet.step([a])
        paid.append(learner_reward(r, infos, RunConfig(), 0.99)[0] - r[0])
    headings = 0.07 * np.array([0, 1, 2, 3, 2])  # rad: 0.7 rad/s for 0.1 s each
    assert paid == pytest.approx(2 * 0.5 * np.cos(headings))
    rewards = [r for _, r, *_ in refly(0, "48880", WORLD, blind=True)]
    assert fleet.envs[0].flight()["return"] == pytest.approx(sum(rewards))


def test_training_test_and_evaluation_forests_are_three_disjoint_ranges() -> None:
    assert deepflight.TESTS[0] >= deepflight.TRAIN_END
    assert deepflight.TESTS[-1] < deepflight.EVAL_FIRST


BAD = """\
train --preset ppo
train --preset
train --batch-size 0
train --batch-size many
train --batch-size 2.5
train --gamma 1.5
train --gamma nan
train --epsilon-final -0.1
train --epsilon-decay inf
train --replay-size 10
train --replay-size 1e6
train --replay-size 1000000000000000
train --learning-starts 20 --num-envs 8
train --steps 5000
train --steps HUGE
train --seed HUGE
train --average 1
train --huber inf
train --num-envs 0
train --num-envs 1001
train --n-steps 0
train --n-steps 100 --learning-starts 800
train --lr -1
train --lr nan
train --lr-decay 2
train --goal-value inf
train --far-value nan
train --huber 0
train --adam 1
train --threads 0
train --steps 0
train --steps -5
train --test-every 0
train --update-every 0
train --name a/b
train --name ..
train --name .
train --name runs/a
train --name taken
train --name EMPTY
train --name a\tb
train --name LONG
train --seed -1
train --seed 1.5
train --colour red
train --demos nowhere.json
train --demos .
train --demos pipe
train --demos /dev/zero
train --demos text.pt
train --demos demos/list.json
train --demos demos/empty.json
train --demos demos/digit.json
train --demos demos/ended.json
train --demos demos/short.json
train --demos demos/late.json
train --demos demos/test.json
train --demos demos/none.json
train --demos demos/other.json
train --demos demos/return.json
train --demos demos/nan.json
train --demos LONG
train --demos demos/types.json
train --demos demos/good.json --beacon
train --demos EMPTY
train --no-bellman
train --demo-updates 0
train --demo-share 1.5
train --margin -1
train --resume runs/taken --demos demos/good.json
train now
train --resume nowhere
train --resume runs/taken --name other
train --resume runs/taken --preset mnih
train --resume runs/taken --preset default
train --resume runs/taken --lr 0.1
train --resume runs/taken
train --resume paper.pt
train --resume runs/taken/log.csv
train --resume EMPTY
train --resume runs/old/checkpoint.pt
eval --pilots laser pigeon
eval --pilots text.pt
eval --pilots demos/return.json
eval --pilots demos/good.json demos/good.json
eval --pilots demos/good.json --beacon
eval --pilots
eval --episodes 0
eval --episodes -5
eval --episodes few
eval --first-seed -1
eval --weights nowhere.pt
eval --weights foreign.pt
eval --weights pickle.pt
eval --weights text.pt
eval --weights small.pt
eval --weights .
eval --weights pipe
eval --weights /dev/zero
eval --weights EMPTY
eval --weights nan.pt
eval --weights bare.pt
eval --threads 0
eval --episodes 1000000000000000
eval --first-seed HUGE
eval --json .
eval --json EMPTY
eval --json /dev/null
eval --json pipe
eval --json text.pt
eval --json paper.pt
eval --json link
eval --json runs/eval/flight.gif
eval --json text.pt/x.json
eval --json LONG
eval --json new/LONG/new
eval --out new/LONG/new
eval --out DEEP
eval --json diary
eval --json o --out o
eval --json o/flight.gif/r.json --out o
eval --weights LONG
eval --out taken
eval --out EMPTY
eval --out text.pt
eval --out text.pt/deeper
eval --beacon --weights paper.pt
eval --camera disparity --weights paper.pt
eval --camera colour
train --camera colour
train --camera EMPTY
fly
"""


def write_demos(folder: Path) -> None:
    """A good file of demonstrations, and others with one thing wrong."""
    folder.mkdir()
    good = fly(straight_pilot, [0, 1], WORLD, blind=True)
    files = {"good": good, "none": [], "short": [good[0] | {"actions": good[0]["actions"][:-1]}]}
    files["digit"] = [good[0] | {"actions": "9" + good[0]["actions"][1:]}]
    arrived = fly(laser_pilot(0.99), [0], WORLD, blind=True)[0]
    files["other"] = [arrived | {"actions": arrived["actions"][:-1] + "0"}]
    assert arrived["actions"][-1] != "0"
    files["return"] = [arrived | {"return": arrived["return"] + 1}]
    files["nan"] = [arrived | {"return": math.nan}]
    files["late"] = [good[0] | {"actions": good[0]["actions"] + "4"}]
    files["ended"] = [good[0], good[1] | {"outcome": "goal"}]
    files["test"] = fly(straight_pilot, [deepflight.TESTS[0]], WORLD, blind=True)
    files["types"] = [good[0] | {"actions": [4] * good[0]["steps"]}]
    for name, flights in files.items():
        report = {"beacon": False, "pilots": {"straight": {"flights": flights}}}
        (folder / f"{name}.json").write_text(json.dumps(report))
    (folder / "list.json").write_text("[]")
    (folder / "empty.json").write_text("")


def test_bad_input_is_one_line_and_exit_code_2_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    lines = [*BAD.splitlines(), ""]
    assert len(lines) > 50
    torch.save({"weights": torch.zeros(3)}, tmp_path / "foreign.pt")
    (tmp_path / "pickle.pt").write_bytes(pickle.dumps(subprocess.Popen))
    (tmp_path / "text.pt").write_text("no weights")
    (tmp_path / "runs/taken").mkdir(parents=True)
    save_weights(tmp_path / "paper.pt", QNetwork(9), beacon=False, camera="grey")
    save_weights(tmp_path / "small.pt", QNetwork(5), beacon=False, camera="grey")
    (tmp_path / "runs/taken/log.csv").write_text("step")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/flight.gif").write_bytes(b"GIF89a, and not ours")
    (tmp_path / "diary").write_text("my diary on Deep Flight")
    (tmp_path / "link").symlink_to(tmp_path / "text.pt")
    os.mkfifo(tmp_path / "pipe")
    write_demos(tmp_path / "demos")
    network = {name: x.half() for name, x in QNetwork(9).state_dict().items()}
    save(tmp_path / "bare.pt", "weights", {"network": network})
    network["head.2.bias"] = network["head.2.bias"] * torch.nan
    save(tmp_path / "nan.pt", "weights", {"network": network, "beacon": False, "camera": "grey"})
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    for line in lines:
        words = line.replace("HUGE", "9" * 400).replace("LONG", "x" * 300)
        words = words.replace("DEEP", "a/" * 1900).split(" ")
        code = deepflight.main(["" if word == "EMPTY" else word for word in words if word])
        out, error = capsys.readouterr()
        assert code == 2, line
        assert error.count("\n") == 1, line
        assert "error: " in error, line
        assert not out, line
        assert sorted(tmp_path.rglob("*")) == before, line


# -------------------------------------------------- train

SHORT = ("--learning-starts", 400, "--test-every", 400, "--threads", 1, "--batch-size", 16)


def test_twenty_seconds_of_training_through_the_real_command_line(tmp_path: Path) -> None:
    done = command("train", "--steps", 800, *SHORT, "--name", "first", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    run = tmp_path / "runs" / "first"
    files = {"best.pt", "checkpoint.pt", "config.json", "log.csv"}
    assert {p.name for p in run.iterdir()} == files
    saved = load(run / "checkpoint.pt", "checkpoint")["settings"]
    assert json.loads((run / "config.json").read_text()) == saved
    assert saved == asdict(DQNConfig()) | asdict(RunConfig()) | {
        "steps": 800, "learning_starts": 400, "test_every": 400, "threads": 1, "batch_size": 16
    }  # fmt: skip
    with (run / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == [400, 800]
    assert [int(row["updates"]) for row in rows] == [2, 102]
    for row in rows:
        assert sum(float(row[f"test_{o}"]) for o in OUTCOMES) == pytest.approx(1)
        assert float(row["epsilon"]) == pytest.approx(1 - 0.95 * int(row["step"]) / 40_000)
    load_weights(run / "best.pt", 9, beacon=False, camera="grey")
    assert max(map(len, done.stdout.splitlines()[1:])) <= 60
    log = (run / "log.csv").read_bytes()

    again = command("train", "--steps", 800, *SHORT, "--name", "first", folder=tmp_path)
    assert again.returncode == 2, "an existing run is never overwritten"
    assert (run / "log.csv").read_bytes() == log

    command("train", "--steps", 800, *SHORT, folder=tmp_path)
    same = (tmp_path / "runs/001/log.csv").read_bytes()
    clock = rb",[\w.]+\n"  # the last column, seconds
    assert re.sub(clock, b"", same) == re.sub(clock, b"", log), "same seed, same bytes"


# -------------------------------------------------- eval


def beats_the_papers_figure(weights: Path, folder: Path) -> bool:
    """Whether the weights fly more than 180 % longer than random, by eval's own report."""
    report = folder / f"{weights.stem}.json"
    words = ["--weights", weights, "--pilots", "random", "dqn", "--episodes", 20, "--json", report]
    done = command("eval", *words, folder=folder)
    assert done.returncode == 0, done.stderr
    return json.loads(report.read_text())["pilots"]["dqn"]["over_random"]["value"] > 1.8


def test_the_shipped_pilot_beats_the_papers_180_percent(tmp_path: Path) -> None:
    assert beats_the_papers_figure(ROOT / "weights/paper.pt", tmp_path)
    assert {p.name for p in (tmp_path / "runs/eval").iterdir()} == {"flight.gif"}
    pilots = json.loads((tmp_path / "paper.json").read_text())["pilots"]
    assert len(pilots["random"]["flights"]) == 2000
    for flight in pilots["dqn"]["flights"][:3] + pilots["random"]["flights"][:3]:
        steps = list(refly(flight["seed"], flight["actions"], WORLD, blind=True))
        assert len(steps) == flight["steps"] + 1
        assert steps[-1][-1]["outcome"] == flight["outcome"]
        assert steps[-1][-1]["edge"] == flight["edge"]
        assert steps[-1][-1]["progress"] == flight["progress"]
        assert sum(step[1] for step in steps) == pytest.approx(flight["return"])


def test_recorded_flights_are_one_more_column_over_their_own_forests(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    flights = fly(straight_pilot, [8, 3, 8], WORLD, blind=True)
    report = {"beacon": False, "pilots": {"you": {"flights": flights}}}
    Path("mine.json").write_text(json.dumps(report))
    assert deepflight.main(["eval", "--pilots", "straight", "mine.json", "--json", "out.json"]) == 0
    pilots = json.loads(Path("out.json").read_text())["pilots"]
    assert pilots["mine.json"] == pilots["straight"]
    assert [flight["seed"] for flight in pilots["mine.json"]["flights"]] == [8, 3]


def test_the_shipped_beacon_pilot_flies_in_its_own_world_only() -> None:
    load_weights(ROOT / "weights/beacon.pt", 9, beacon=True, camera="grey")
    with pytest.raises(ValueError, match=r"was trained with .*True"):
        load_weights(ROOT / "weights/beacon.pt", 9, beacon=False, camera="grey")


def test_an_untrained_pilot_does_not(tmp_path: Path) -> None:
    torch.manual_seed(0)
    save_weights(tmp_path / "untrained.pt", QNetwork(9), beacon=False, camera="grey")
    assert not beats_the_papers_figure(tmp_path / "untrained.pt", tmp_path)
