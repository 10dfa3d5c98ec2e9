"""Each answer is a change that fits the present code, and its table is what was measured."""

import ast
from pathlib import Path

import pytest

from extras.lessons.exercises import RESULT, TEXT, prepare, read, table

ANSWERS = [str(number) for number in range(13)]
CHANGED = {"4": "env", "5": "env", "6": "dqn", "7": "dqn", "8": "env", "9": "env"}
CHANGED |= {"10": "deepflight", "11": "env", "12": "dqn env"}


@pytest.mark.parametrize("number", ANSWERS)
def test_an_answer_changes_what_it_names_and_is_python(number: str, tmp_path: Path) -> None:
    prepare(number, tmp_path / "copy")
    changed = []
    for name in ("deepflight", "dqn", "env", "render"):
        text = (tmp_path / f"copy/{name}.py").read_text()
        ast.parse(text)
        changed += [name] if text != (TEXT.parents[2] / f"{name}.py").read_text() else []
    assert changed == CHANGED.get(number, "").split()
    assert changed or read(number)[1]


def test_the_table_is_what_was_measured() -> None:
    assert RESULT.exists() and table() in TEXT.read_text()
