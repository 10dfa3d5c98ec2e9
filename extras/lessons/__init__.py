"""One further idea a file, each with the training loop that shows it and a command of its own."""

from dataclasses import field, fields, make_dataclass
from typing import Any


def recipe(name: str, config: type, **changes: Any) -> type:
    """A configuration like another, but for the defaults of some settings, or class variables.

    >>> import deepflight
    >>> Short = recipe("Short", deepflight.Config, steps=1_000, pilot="short")
    >>> Short().steps, Short(steps=2_000).steps, Short().gamma, Short.pilot
    (1000, 2000, 0.99, 'short')
    """
    changed = [f for f in fields(config) if f.name in changes]
    settings = [
        (f.name, f.type, field(default=changes.pop(f.name), metadata=f.metadata)) for f in changed
    ]
    return make_dataclass(name, settings, bases=(config,), namespace=changes, frozen=True)
