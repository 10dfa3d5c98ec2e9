"""The flags lead from the textbook to the recipe; committed trainings had these settings."""

import json
from dataclasses import asdict, fields, replace
from pathlib import Path

import pytest

import deepflight
from deepflight import Config
from extras.experiments import ladder
from extras.experiments.ladder import PANELS, RECIPE, ROOT, RUNGS, Training
from extras.lessons.mnih import MnihConfig, TextbookConfig

CONFIGS = {
    RECIPE: Config,
    ladder.MNIH: MnihConfig,
    (*ladder.MNIH, "textbook"): TextbookConfig,
}


def settings(training: Training) -> Config:
    """What `train` makes of a training's flags."""
    config = CONFIGS[training.program]
    given = vars(deepflight.parse(["train", *training.flags], config))
    names = {f.name for f in fields(config)}
    given = {key: value for key, value in given.items() if key in names and value is not None}
    return config(**given | {"seed": training.seed})


def test_the_last_rung_is_the_recipe_and_each_rung_changes_what_it_names() -> None:
    rungs = [asdict(settings(x)) for x in ladder.trainings() if x.label in RUNGS and not x.seed]
    assert rungs[-1] == asdict(Config(steps=100_000))
    for lower, higher, more in zip(rungs, rungs[1:], [*RUNGS.values()][1:], strict=False):
        named = {word[2:].replace("-", "_") for word in more if word.startswith("--")}
        assert {key for key in higher if higher[key] != lower[key]} == named


def test_each_training_has_a_folder_of_its_own_and_the_committed_ones_these_settings() -> None:
    trainings = list(ladder.trainings())
    assert len({training.name for training in trainings}) == len(trainings)
    for training in trainings:
        c = settings(training)
        if training.program != RECIPE or training.flags:
            saved = json.loads((training.kept / "config.json").read_text())
            assert type(c)(**saved) == replace(c, threads=saved["threads"]), training.name
            assert saved.keys() == asdict(c).keys()


def test_an_interrupted_training_goes_on_and_a_finished_one_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = []
    monkeypatch.setattr(ladder, "ROOT", tmp_path)
    monkeypatch.setattr(ladder.subprocess, "run", lambda line, **more: lines.append(line[1:]))
    training = Training("ladder-x-1", "label", 1, ladder.MNIH, ("--steps", "800"))
    train = ["-m", "extras.lessons.mnih", "train"]
    begin = ["--name", "ladder-x-1", "--threads", "1", "--seed", "1", "--steps", "800"]
    for passes, expected in (
        (None, [*train, *begin]),
        (50, [*train, "--resume", str(tmp_path / "runs/ladder-x-1")]),
        (100, None),
    ):
        if passes:
            training.folder.mkdir(parents=True, exist_ok=True)
            content = {"config": {"steps": 800, "num_envs": 8}, "actions": [bytes(8)] * passes}
            deepflight.save(training.folder / "checkpoint.pt", content)
        lines.clear()
        ladder.go_on(training)
        assert lines == ([expected] if expected else [])


def test_the_picture_is_drawn_from_the_committed_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "figures").mkdir()
    (tmp_path / "results").symlink_to(ROOT / "results")
    monkeypatch.setattr(ladder, "ROOT", tmp_path)
    ladder.draw()
    assert (tmp_path / "figures/ladder.png").stat().st_size > 10_000


def test_the_page_shows_what_was_flown() -> None:
    page = (ROOT / "results/README.md").read_text()
    for label, seeds in ladder.flown().items():
        cells = [" "] * 3
        for seed, found in seeds.items():
            best = (factor * found["best"][key]["value"] for key, (_, factor) in PANELS.items())
            cells[int(seed)] = f" {' / '.join(f'{x:.0f}' for x in best)} "
        assert f"| {label} |{'|'.join(cells)}|\n" in page
