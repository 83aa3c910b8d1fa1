"""Ends a training after its current update when the process is asked to stop."""

import signal
import sys
from types import FrameType
from typing import Any, NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Ctrl-C, and what batch systems and ``kill`` send."""


class Interrupt:
    """Context in which the first Ctrl-C or SIGTERM only sets ``asked``; a second one ends the run at once."""

    asked: int | None = None
    """Number of the signal that asked to stop."""

    def __enter__(self) -> "Interrupt":
        self._before: dict[int, Any] = {number: signal.signal(number, self._ask) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()

    def _ask(self, number: int, _: FrameType | None) -> None:
        self.asked = number
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        self._before = {}


def exit_code(number: int) -> int:
    """The exit code of a process that a signal has ended, as shells count it: 130 or 143."""
    return 128 + number


def interrupt(number: int, _: FrameType | None) -> NoReturn:
    """Handle a signal as Ctrl-C; the error holds the signal's number."""
    raise KeyboardInterrupt(number)


def end_interrupted(error: KeyboardInterrupt) -> NoReturn:
    """End a program that the same command continues."""
    print("interrupted; run the same command again to continue", file=sys.stderr)
    sys.exit(exit_code(error.args[0] if error.args else signal.SIGINT))
