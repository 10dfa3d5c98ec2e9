"""A training is drawn over the committed ones that have its settings, or one line says why not."""

import json
from pathlib import Path

import pytest

from extras.experiments import compare


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(compare, "ROOT", tmp_path)
    for seed, folder in enumerate(("results/dqn", "results/dqn-1", "run")):
        path = tmp_path / folder
        path.mkdir(parents=True)
        (path / "config.json").write_text(json.dumps({"gamma": 0.99, "seed": seed, "threads": 2}))
        rows = [",".join(("step", *compare.PANELS))]
        rows += [f"{5000 * i},{i * (1 + seed % 2)},{i},{i}" for i in range(1, 9)]
        (path / "log.csv").write_text("\n".join(rows))
    return tmp_path / "run"


def test_a_training_stands_within_the_band_of_seeds_that_it_belongs_to(
    run: Path, capsys: pytest.CaptureFixture
) -> None:
    assert compare.main([str(run)]) == 0
    assert capsys.readouterr().out.count(", within ") == len(compare.PANELS)
    assert (run / "compare.png").stat().st_size > 10_000


def test_a_folder_without_a_log_or_with_settings_that_no_seed_had_is_refused(
    run: Path, capsys: pytest.CaptureFixture
) -> None:
    assert compare.main([str(run.parent)]) == 2
    assert "config.json" in capsys.readouterr().err
    (run / "config.json").write_text(json.dumps({"gamma": 0.5, "seed": 0, "threads": 2}))
    assert compare.main([str(run)]) == 2
    assert "differs in ['gamma']" in capsys.readouterr().err


def test_a_curve_is_the_mean_of_the_last_five_validations(run: Path) -> None:
    _, y = compare.curve(run, "validation_return")
    assert y.tolist() == [1, 1.5, 2, 2.5, 3, 4, 5, 6]
