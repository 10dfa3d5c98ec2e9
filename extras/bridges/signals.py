"""Signals that end a training: Ctrl-C, and what a cluster's scheduler sends to a job."""

import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager


@contextmanager
def ended_by_signals() -> Iterator[list[int]]:
    """The first signal raises KeyboardInterrupt; later ones only join the list, so that the weights
    get written. One that nohup ignores stays ignored."""
    stopped: list[int] = []

    def stop(number: int, _: object) -> None:
        stopped.append(number)
        if len(stopped) == 1:
            raise KeyboardInterrupt

    with ExitStack() as afterwards:
        for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1"):  # Windows lacks the last two
            number = getattr(signal, name, signal.SIGINT)
            if signal.getsignal(number) != signal.SIG_IGN:
                afterwards.callback(signal.signal, number, signal.signal(number, stop))
        yield stopped
