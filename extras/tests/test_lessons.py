"""The form of a lesson: its loop is that of dqn.py but for lines that say so."""

import inspect

import pytest

import dqn
from extras.lessons import run
from extras.lessons.demonstrations import DemoConfig
from extras.lessons.expert import ExpertConfig
from extras.lessons.mnih import MnihConfig, TextbookConfig
from extras.lessons.pqn import PQNConfig


@pytest.mark.parametrize("config", [ExpertConfig, DemoConfig, MnihConfig, PQNConfig])
def test_diff_adds_no_line_to_the_loop_that_is_not_marked(
    config: type, capsys: pytest.CaptureFixture
) -> None:
    assert run(config, ["diff"]) == 0
    added = [line for line in capsys.readouterr().out.splitlines() if line[0] == "+"]
    assert added[0].startswith("+++")
    assert added[1].startswith("+def train(c:")
    assert added[2].lstrip("+ ").startswith('"""Algorithm 1')
    assert added[3:]
    assert all("[!]" in line for line in added[3:])
    assert len(inspect.getsource(config.train).splitlines()) <= 45
    assert list(inspect.signature(config.train).parameters) == ["c", "envs", "rng", "shaped"]


def test_the_textbook_has_the_loop_of_dqn_itself(capsys: pytest.CaptureFixture) -> None:
    assert TextbookConfig.train is dqn.train
    assert run(TextbookConfig, ["diff"]) == 0
    assert not capsys.readouterr().out.strip()
