"""The form of a lesson: its loop is that of dqn.py but for lines that say so."""

import inspect

import pytest

import dqn
from extras.lessons import run
from extras.lessons.demonstrations import DemoConfig
from extras.lessons.drqn import DRQNConfig
from extras.lessons.expert import ExpertConfig
from extras.lessons.memory import MemoryConfig
from extras.lessons.mnih import MnihConfig, TextbookConfig
from extras.lessons.place import PlaceConfig
from extras.lessons.pqn import PQNConfig

LESSONS = {ExpertConfig: "dqn", DemoConfig: "dqn", MnihConfig: "dqn", PQNConfig: "dqn"}
LESSONS |= {MemoryConfig: "pqn", DRQNConfig: "pqn", PlaceConfig: "expert"}


@pytest.mark.parametrize("config", LESSONS)
def test_diff_adds_no_line_to_the_loop_that_is_not_marked(
    config: type, capsys: pytest.CaptureFixture
) -> None:
    assert run(config, ["diff"]) == 0
    before, after, *lines = capsys.readouterr().out.splitlines()
    assert before.endswith(f"{LESSONS[config]}.train") and after == "+++ train"
    added = [line for line in lines if line[0] == "+" and "def train(c:" not in line]
    assert added[0].lstrip("+ ").startswith('"""') and added[1:]
    assert all("[!]" in line for line in added[1:])
    assert len(inspect.getsource(config.train).splitlines()) <= 45
    assert list(inspect.signature(config.train).parameters) == ["c", "envs", "rng", "shaped"]


def test_the_textbook_has_the_loop_of_dqn_itself(capsys: pytest.CaptureFixture) -> None:
    assert TextbookConfig.train is dqn.train
    assert run(TextbookConfig, ["diff"]) == 0
    assert not capsys.readouterr().out.strip()
