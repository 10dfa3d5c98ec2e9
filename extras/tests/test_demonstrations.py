"""The experiment, small: demonstrations alone are learned and flown; see test_ladder.py too."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from env import fly, random_pilot
from extras.experiments import demonstrations, ladder
from extras.lessons.expert import DemoConfig


def test_counted_demonstrations_are_learned_and_flown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demonstrations, "COUNTS", (1,))
    monkeypatch.setattr(demonstrations, "RESULT", tmp_path / "demonstrations.json")
    monkeypatch.setattr(demonstrations, "DemoConfig", lambda: DemoConfig(demo_updates=2))
    for module in (demonstrations, ladder):
        monkeypatch.setattr(module, "FORESTS", range(3))
    monkeypatch.setattr(ladder, "fly_random", partial(fly, random_pilot(np.random.default_rng(0))))
    demonstrations.count_all()
    report = json.loads((tmp_path / "demonstrations.json").read_text())
    assert list(report) == ["1 demonstrations"]
    assert {*demonstrations.PANELS} < report["1 demonstrations"]["0"].keys()
