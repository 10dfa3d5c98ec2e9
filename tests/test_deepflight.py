"""The experiment: pilots, statistics, the two commands, and whether the shipped pilot can fly."""

import csv
import json
import math
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import deepflight
from deepflight import (
    MNIH,
    Config,
    Training,
    dynamic_window,
    fly,
    fly_random,
    interval,
    laser_pilot,
    summarize,
    wilson,
)
from dqn import QNetwork, load
from env import World, refly

ROOT = Path(__file__).parent.parent
WORLD = World()
OPEN = (np.linspace(0, 2 * math.pi, 360, endpoint=False), np.full(360, 20.0))  # a scan of nothing


def command(*words: object, folder: Path) -> subprocess.CompletedProcess:
    """Run the real command line in a folder of its own."""
    line = [sys.executable, str(ROOT / "deepflight.py"), *map(str, words)]
    return subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False)


# -------------------------------------------------- pilots


def test_in_the_open_the_laser_pilot_turns_to_the_goal() -> None:
    assert dynamic_window(*OPEN, 0.0, WORLD) == 4
    assert dynamic_window(*OPEN, 2.0, WORLD) == 8
    assert dynamic_window(*OPEN, -2.0, WORLD) == 0
    assert dynamic_window(*OPEN, 0.35 * 1.5, WORLD) == 6  # 0.35 rad/s for 1.5 s


def test_the_laser_pilot_turns_away_from_a_trunk_ahead() -> None:
    bearings, distances = OPEN[0], OPEN[1].copy()
    distances[:12] = 4.0  # bark from dead ahead to 12 degrees left
    assert dynamic_window(bearings, distances, 0.0, WORLD) < 4
    assert dynamic_window(bearings, np.roll(distances, -11), 0.0, WORLD) > 4


def test_the_laser_pilot_arrives_and_never_crashes() -> None:
    flights = fly("laser", laser_pilot, range(2 * 10**9, 2 * 10**9 + 20), WORLD, camera=False)
    assert not any(f["outcome"] == "crash" for f in flights)
    assert sum(f["outcome"] == "goal" for f in flights) >= 17


def test_the_random_pilot_draws_its_actions_uniformly() -> None:
    flights = fly_random([5, 6], WORLD, np.random.default_rng(0))
    assert len(flights) == 2000
    assert [f["seed"] for f in flights[:4]] == [5, 6, 5, 6]
    actions = "".join(f["actions"] for f in flights)
    shares = np.array([actions.count(str(a)) for a in range(9)]) / len(actions)
    assert shares == pytest.approx(1 / 9, abs=0.006)  # four standard errors of 40,000 draws


# -------------------------------------------------- statistics


def test_wilson_is_the_interval_whose_ends_are_1_96_standard_errors_away() -> None:
    for hits, n in ((0, 10), (3, 20), (50, 100), (500, 500)):
        figure = wilson(hits, n)
        for end in (figure["low"], figure["high"]):
            if 1e-9 < end < 1 - 1e-9:
                z = (hits / n - end) / math.sqrt(end * (1 - end) / n)
                assert abs(z) == pytest.approx(1.96)


def test_the_bootstrap_finds_the_normal_interval_of_a_mean() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(10, 3, 400)
    figure = interval(x.mean(), x[rng.integers(400, size=(2000, 400))].mean(1))
    assert figure["high"] - figure["low"] == pytest.approx(2 * 1.96 * x.std() / 20, rel=0.1)


def test_the_figures_of_two_forests_by_hand() -> None:
    ended = {"progress": 10.0, "return": -1.0, "outcome": "crash", "edge": ""}
    bar = [ended | {"steps": n} for n in (10, 30, 20, 40)]  # forests A, B, A, B: 15 and 35 steps
    far = {"progress": 90.0, "return": 9.0, "outcome": "left", "edge": "far"}
    flights = [ended | {"steps": 30}, far | {"steps": 170}]
    figures = summarize(flights, bar, 2, np.random.default_rng(0))
    # Resampling two forests gives A twice, B twice or one of each: ratios 2, 34/7 and 4.
    assert figures["over_random"] == pytest.approx({"value": 3.0, "low": 1.0, "high": 27 / 7})
    assert figures["steps"] == {"value": 100.0, "low": 30.0, "high": 170.0}
    assert figures["seconds"] == pytest.approx({"value": 10.0, "low": 3.0, "high": 17.0})
    shares = {key: figures[key]["value"] for key in ("crossed", "crash", "left", "goal", "time")}
    assert shares == {"crossed": 0.5, "crash": 0.5, "left": 0.5, "goal": 0.0, "time": 0.0}
    same = summarize(bar, bar, 2, np.random.default_rng(0))["over_random"]
    assert same == {"value": 0.0, "low": 0.0, "high": 0.0}


# -------------------------------------------------- settings


def test_the_mnih_preset_is_extended_data_table_1() -> None:
    c = Config(**MNIH)
    assert (c.steps, c.replay, c.warmup, c.batch) == (1_400_000, 1_000_000, 50_000, 32)
    assert (c.epsilon_start, c.epsilon_final, c.epsilon_decay) == (1.0, 0.1, 1_000_000)
    assert (c.update_every, c.target_every, c.gamma) == (4, 10_000, 0.99)
    assert (c.optimizer, c.lr, c.lr_final, c.optimizer_eps) == ("rmsprop", 2.5e-4, 2.5e-4, 0.01)
    assert (c.n, c.double, c.mirror, c.huber) == (1, False, False, 1.0)
    assert (c.max_grad_norm, c.precision) == (0.0, "float32")
    assert (c.goal_value, c.far_value, c.ahead, c.average) == (0.0, 0.0, 0.0, 0.0)


def test_where_the_beacon_shows_the_goal_nothing_else_is_worth_as_much(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    small = "--threads 1 --replay 400 --warmup 400"
    for line, worth in (
        ("", (125, 200, 6)),
        ("--beacon", (125, 50, 0)),
        ("--beacon --ahead 1", (125, 50, 1)),
    ):
        deepflight.prepare_train(deepflight.parse(f"train {small} {line}".split()))
        newest = max((tmp_path / "runs").iterdir()) / "checkpoint.pt"
        c = load(newest, "checkpoint")["config"]
        assert (c["goal_value"], c["far_value"], c["ahead"]) == worth


def test_training_test_and_evaluation_forests_are_three_disjoint_ranges() -> None:
    tests = range(deepflight.TEST_FIRST, deepflight.TEST_FIRST + 10_000)  # at most, by Config
    assert tests[0] >= deepflight.TRAIN_END
    assert tests[-1] < deepflight.EVAL_FIRST


BAD = """\
train --preset ppo
train --preset
train --batch 0
train --batch many
train --batch 2.5
train --gamma 1.5
train --gamma nan
train --epsilon-final -0.1
train --epsilon-start inf
train --optimizer sgd
train --replay 10
train --replay 1e6
train --replay 100000000000000
train --warmup 20 --lanes 8
train --lanes 0
train --lanes 1001
train --n 0
train --n 100 --warmup 800
train --lr -1
train --lr nan
train --goal-value inf
train --far-value nan
train --max-grad-norm -1
train --precision float16
train --device tpu
train --threads 0
train --steps 0
train --steps -5
train --test-every 0
train --test-forests 0
train --checkpoint-every 0
train --update-every 0
train --name a/b
train --name ..
train --name .
train --name runs/a
train --name taken
train --seed -1
train --seed 1.5
train --colour red
train now
train --resume nowhere
train --resume runs/taken --name other
train --resume runs/taken
train --resume paper.pt
eval --pilots laser pigeon
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
eval --json nowhere/x.json
eval --json .
eval --out text.pt
eval --beacon --weights paper.pt
fly
"""


def test_bad_input_is_one_line_and_exit_code_2_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    lines = [*BAD.splitlines(), ""]
    assert len(lines) > 50
    torch.save({"weights": torch.zeros(3)}, tmp_path / "foreign.pt")
    (tmp_path / "pickle.pt").write_bytes(pickle.dumps(subprocess.Popen))
    (tmp_path / "text.pt").write_text("no weights")
    (tmp_path / "runs/taken").mkdir(parents=True)
    deepflight.save_weights(tmp_path / "paper.pt", QNetwork(9), beacon=False)
    deepflight.save_weights(tmp_path / "small.pt", QNetwork(5), beacon=False)
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    for line in lines:
        try:
            code = deepflight.main(line.split())
        except SystemExit as stop:  # argparse's way
            code = stop.code
        out, error = capsys.readouterr()
        assert code == 2, line
        assert error.count("\n") == 1, line
        assert "error: " in error, line
        assert not out, line
        assert sorted(tmp_path.rglob("*")) == before, line


# -------------------------------------------------- train

SHORT = ("--warmup", 400, "--test-every", 400, "--test-forests", 4, "--threads", 1, "--batch", 16)


def test_twenty_seconds_of_training_through_the_real_command_line(tmp_path: Path) -> None:
    done = command("train", "--steps", 1200, *SHORT, "--name", "first", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    run = tmp_path / "runs" / "first"
    files = {"best.pt", "checkpoint.pt", "config.json", "lock", "log.csv", "timing.csv"}
    assert {p.name for p in run.iterdir()} == files
    assert json.loads((run / "config.json").read_text())["steps"] == 1200
    with (run / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == [400, 800, 1200]
    assert [int(row["updates"]) for row in rows] == [2, 102, 202]
    for row in rows:
        assert sum(float(row[f"test_{o}"]) for o in deepflight.OUTCOMES) == pytest.approx(1)
        assert float(row["epsilon"]) == pytest.approx(1 - 0.95 * int(row["step"]) / 40_000)
    deepflight.load_weights(run / "best.pt", beacon=False)
    log = (run / "log.csv").read_bytes()

    again = command("train", "--steps", 1200, *SHORT, "--name", "first", folder=tmp_path)
    assert again.returncode == 2, "an existing run is never overwritten"
    assert (run / "log.csv").read_bytes() == log

    command("train", "--steps", 1200, *SHORT, folder=tmp_path)
    assert (tmp_path / "runs/001/log.csv").read_bytes() == log, "same seed, same bytes"


def test_another_seed_is_another_network_in_other_forests(tmp_path: Path) -> None:
    runs = []
    for seed in (0, 1):
        (tmp_path / str(seed)).mkdir()
        runs.append(Training(Config(seed=seed, threads=1), tmp_path / str(seed)))
        runs[-1].begin()
    assert runs[0].record() != runs[1].record()
    assert (runs[0].agent.q.head[2].weight != runs[1].agent.q.head[2].weight).all()


def test_in_the_last_share_of_steps_the_mean_of_the_weights_flies(tmp_path: Path) -> None:
    c = Config(steps=960, warmup=480, update_every=8, average=0.25, test_forests=1, threads=1)
    run = Training(c, tmp_path)
    run.begin()
    run.book["bar"], newest = 27.0, []
    for step in range(8, 961, 8):  # an update each
        row = run.step()
        newest.append(run.agent.q.head[2].weight.detach().clone())
        if step == 720:
            copied, flown = run.agent.q_target.head[2].weight.clone(), newest[-1]
        if step == 960:
            flown = torch.stack([copied, *newest[-29:]]).mean(0)
        if step in (720, 960):
            run.test(row)
            saved = deepflight.load_weights(tmp_path / "best.pt", beacon=False).head[2].weight
            assert torch.allclose(saved, flown, rtol=0, atol=1e-4)
    assert not torch.allclose(saved, newest[-1], rtol=0, atol=3e-4)


def test_a_metre_ahead_is_worth_its_reward_in_the_target_and_not_in_the_report(
    tmp_path: Path,
) -> None:
    runs = [Training(Config(lanes=1, ahead=ahead, threads=1), tmp_path) for ahead in (0.0, 3.0)]
    for run in runs:
        run.take_off(0)
        for a in (4, 8, 8, 8, 0):
            run.advance(np.array([a]))
    plain, paid = (run.memory.rewards[:5, 0] for run in runs)
    headings = 0.07 * np.array([0, 1, 2, 3, 2])  # rad: 0.7 rad/s for 0.1 s each
    assert paid - plain == pytest.approx(3 * 0.5 * np.cos(headings), abs=1e-5)
    assert runs[0].envs[0].total == runs[1].envs[0].total


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
    assert {p.name for p in (tmp_path / "runs/eval").iterdir()} == {"flights.png", "flight.gif"}
    pilots = json.loads((tmp_path / "paper.json").read_text())["pilots"]
    assert len(pilots["random"]["flights"]) == 2000
    for flight in pilots["dqn"]["flights"][:3] + pilots["random"]["flights"][:3]:
        steps = list(refly(flight["seed"], flight["actions"], WORLD, camera=False))
        assert len(steps) == flight["steps"] + 1
        assert steps[-1][-1]["outcome"] == flight["outcome"]
        assert steps[-1][-1]["edge"] == flight["edge"]
        assert steps[-1][-1]["progress"] == flight["progress"]
        assert sum(step[1] for step in steps) == pytest.approx(flight["return"])


def test_the_shipped_beacon_pilot_flies_in_its_own_world_only() -> None:
    deepflight.load_weights(ROOT / "weights/beacon.pt", beacon=True)
    with pytest.raises(ValueError, match="trained with the beacon"):
        deepflight.load_weights(ROOT / "weights/beacon.pt", beacon=False)


def test_an_untrained_pilot_does_not(tmp_path: Path) -> None:
    torch.manual_seed(0)
    deepflight.save_weights(tmp_path / "untrained.pt", QNetwork(9), beacon=False)
    assert not beats_the_papers_figure(tmp_path / "untrained.pt", tmp_path)
