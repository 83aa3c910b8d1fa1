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


def interrupt(number: int, _: FrameType | None) -> NoReturn:
    """Handle a signal as Ctrl-C; the error holds the signal's number."""
    raise KeyboardInterrupt(number)


def number_of(error: KeyboardInterrupt) -> int:
    """The number of the signal that interrupted the program."""
    return error.args[0] if error.args else signal.SIGINT


def end_interrupted(number: int, remedy: str = "") -> NoReturn:
    """End a program that a signal has stopped, with the exit code of shells: 130 or 143."""
    print(f"interrupted; {remedy}" if remedy else "interrupted", file=sys.stderr)
    sys.exit(128 + number)
