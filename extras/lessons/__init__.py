"""One further idea a file, each with the training loop that shows it and a command of its own."""

import inspect
from collections.abc import Sequence
from dataclasses import Field, field, fields, make_dataclass
from difflib import unified_diff
from typing import Any

import deepflight
import dqn


def recipe(name: str, config: type, **changes: Any) -> type:
    """A configuration like `config`. A change is a new default of a known setting, a new setting
    (made by dqn.setting), or else a class variable.

    >>> loud = dqn.setting(False, "say more", 0, 1)
    >>> Short = recipe("Short", deepflight.Config, steps=1_000, loud=loud, pilot="short")
    >>> Short().steps, Short(steps=2_000).steps, Short().gamma, Short().loud, Short.pilot
    (1000, 2000, 0.99, False, 'short')
    """
    known = {f.name: f for f in fields(config)}
    settings, variables = [], {}
    for key, value in changes.items():
        if key in known:
            default = field(default=value, metadata=known[key].metadata)
            settings.append((key, known[key].type, default))
        elif isinstance(value, Field):
            settings.append((key, type(value.default), value))
        else:
            variables[key] = value
    return make_dataclass(name, settings, bases=(config,), namespace=variables, frozen=True)


def run(config: type, argv: Sequence[str]) -> int:
    """The command line of deepflight.py, and `diff`: how a lesson's loop differs from dqn.train."""
    if list(argv) != ["diff"]:
        return deepflight.main(argv, config)
    loops = (inspect.getsource(train).splitlines() for train in (dqn.train, config.train))
    print(*unified_diff(*loops, "dqn.train", f"{config.pilot}: train", lineterm=""), sep="\n")
    return 0
