"""The errors of one line: wrong input of any kind, and a run that cannot go on."""

import sysconfig
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class InputError(ValueError):
    """Wrong input, in one line with key, value, unit and remedy; a recipe prints it and exits with
    code 2."""


RUN_ERROR = 3
"""Exit code of a recipe whose run cannot go on."""


class RunError(RuntimeError):
    """A run that cannot go on, in one line; a recipe prints it and exits with code
    ``RUN_ERROR``."""


@contextmanager
def naming_errors(name: str) -> Iterator[None]:
    """Turn an exception of the user's component into an ``InputError`` with its name, file and
    line."""
    try:
        yield
    except (InputError, RunError):
        raise
    except Exception as error:  # a user's own component can raise anything
        raise InputError(f"{name}: {described(error)}") from error


def described(error: BaseException) -> str:
    """An error on one line: its type, its message, and the deepest line of the user's own code."""
    text = " ".join(str(error).split())
    # Frames that belong neither to this package, nor to an installed one, nor to Python.
    package = str(Path(__file__).parents[1])
    library = sysconfig.get_path("stdlib")
    others = ("site-packages", "dist-packages", "<frozen", package, library)
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not any(other in frame.filename for other in others)]
    known = not own or isinstance(error, SyntaxError)  # its message has the place
    place = "" if known else f" ({Path(own[-1].filename).name}, line {own[-1].lineno})"
    return f"{type(error).__name__}{': ' if text else ''}{text}{place}"
