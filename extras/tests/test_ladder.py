"""The ladder's flags lead from the textbook to the recipe; a curve stands within its own band."""

import json
import shutil
from dataclasses import asdict
from pathlib import Path

import pytest

from deepflight import PRESETS, SETTINGS, RunConfig, configure, parse
from dqn import DQNConfig
from extras.experiments import compare
from extras.experiments.ladder import CONTROLS, RUNGS, trainings

ROOT = Path(__file__).parents[2]


def settings(flags: list[str]) -> dict[str, object]:
    """What `train` makes of these flags."""
    args = parse(["train", *flags])
    given = {f.name: vars(args)[f.name] for f in SETTINGS if f.name in args}
    c, r = configure(PRESETS[args.preset or "default"] | given)
    return asdict(c) | asdict(r)


def test_the_last_rung_is_the_recipe_and_each_rung_changes_what_it_names() -> None:
    rungs = {label: settings(flags) for _, label, _, flags in trainings() if label in RUNGS}
    *_, last = rungs.values()
    assert last == asdict(DQNConfig()) | asdict(RunConfig()) | {"steps": 100_000}
    for (lower, higher), more in zip(
        zip(list(rungs.values())[:-1], list(rungs.values())[1:], strict=True),
        list(RUNGS.values())[1:],
        strict=True,
    ):
        changed = {key for key in higher if higher[key] != lower[key]}
        named = {word[2:].replace("-", "_") for word in more if word.startswith("--")}
        assert changed == named


def test_each_training_of_the_ladder_has_a_folder_of_its_own_and_legal_settings() -> None:
    names = [name for name, *_ in trainings()]
    assert len(names) == len({*names}) == 1 + 2 * len(RUNGS) + 3 + len(CONTROLS) + 1
    for *_, flags in trainings():
        settings(flags)


def test_a_committed_training_stands_within_its_own_band(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    shutil.copytree(ROOT / "results/scratch", tmp_path / "run")
    assert compare.main([str(tmp_path / "run")]) == 0
    assert capsys.readouterr().out.count(", within ") == len(compare.PANELS)
    assert (tmp_path / "run/compare.png").stat().st_size > 10_000
    assert compare.main([str(tmp_path / "run")]) == 0, "its own picture may be replaced"


def test_a_training_without_a_log_or_with_settings_that_no_seed_had_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert compare.main([str(tmp_path)]) == 2
    assert "give a training's folder" in capsys.readouterr().err
    shutil.copytree(ROOT / "results/scratch", tmp_path / "run")
    config = tmp_path / "run/config.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | {"gamma": 0.5}))
    assert compare.main([str(tmp_path / "run")]) == 2
    assert "differs in ['gamma']" in capsys.readouterr().err
    assert not (tmp_path / "run/compare.png").exists()
