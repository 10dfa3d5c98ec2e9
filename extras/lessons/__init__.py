"""One further idea a file, each with the training loop that shows it and a command of its own."""

import inspect
from collections.abc import Sequence
from dataclasses import Field, field, fields, make_dataclass
from difflib import unified_diff
from typing import Any

import deepflight
import dqn


def recipe(name: str, config: type, **changes: Any) -> type:
    """A configuration like another, but for the defaults of some settings, for settings of its own,
    which dqn.setting makes, and for class variables.

    >>> loud = dqn.setting(False, "say more", 0, 1)
    >>> Short = recipe("Short", deepflight.Config, steps=1_000, loud=loud, pilot="short")
    >>> Short().steps, Short(steps=2_000).steps, Short().gamma, Short().loud, Short.pilot
    (1000, 2000, 0.99, False, 'short')
    """
    settings = []
    for f in fields(config):
        if f.name in changes:
            default = field(default=changes.pop(f.name), metadata=f.metadata)
            settings.append((f.name, f.type, default))
    for key in [key for key, value in changes.items() if isinstance(value, Field)]:
        own = changes.pop(key)
        settings.append((key, type(own.default), own))
    return make_dataclass(name, settings, bases=(config,), namespace=changes, frozen=True)


def run(config: type, argv: Sequence[str]) -> int:
    """The command line of deepflight.py, and `diff`: how a lesson's loop differs from dqn.train."""
    if list(argv) != ["diff"]:
        return deepflight.main(argv, config)
    loops = (inspect.getsource(train).splitlines() for train in (dqn.train, config.train))
    print(*unified_diff(*loops, "dqn.train", f"{config.pilot}: train", lineterm=""), sep="\n")
    return 0
