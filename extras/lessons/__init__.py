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
    """The command line of deepflight.py, and `diff`: how a lesson's loop differs from the one that
    it builds on, which is dqn.train or that of another lesson."""
    if list(argv) != ["diff"]:
        if {"-h", "--help"} & set(argv[:1]):
            print("diff: how this lesson's loop differs from the one that it builds on. Else:\n")
        return deepflight.main(argv, config)
    recipes = config.__mro__[: config.__mro__.index(deepflight.Config) + 1]
    old = next((base.train for base in recipes if base.train is not config.train), dqn.train)
    lines = [inspect.getsource(train).splitlines() for train in (old, config.train)]
    lines[0] = [line.replace(" [!]", "").rstrip(" #") for line in lines[0]]  # without its own marks
    print(*unified_diff(*lines, f"{old.__module__}.train", "train", lineterm=""), sep="\n")
    return 0
