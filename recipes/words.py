"""The words of a command line, before Hydra reads them."""

import os
from argparse import ArgumentDefaultsHelpFormatter, ArgumentParser, Namespace
from collections.abc import Sequence
from typing import Any, NoReturn

from damian.common.errors import InputError
from damian.common.text_files import show

FOLDERS = ("checkpoint", "resume", "hydra.run.dir", "hydra.sweep.dir")
"""Keys whose values are folders, which may have any name."""
SECRET = "token"
"""Key of the setting that is a password, which no file should keep."""


class Parser(ArgumentParser):
    """Raises an ``InputError`` instead of printing its usage; its help names the defaults."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, formatter_class=ArgumentDefaultsHelpFormatter, allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        raise InputError(message)


def parsed(words: Sequence[str]) -> Namespace:
    """The options and the ``overrides`` of a command line; options may stand anywhere.

    Raises:
        InputError: an option does not exist, or lacks its value.
    """
    parser = Parser(add_help=False)
    parser.add_argument("-h", "--help", action="store_true")
    parser.add_argument("-m", "--multirun", action="store_true")
    parser.add_argument("-cd", "--config-dir")
    parser.add_argument("--cfg", choices=["job"])
    parser.add_argument("overrides", nargs="*")
    given = parser.parse_intermixed_args(list(words))
    if given.config_dir and not os.path.isdir(given.config_dir):
        raise InputError(f"--config-dir: {show(given.config_dir)} is no folder")
    if not given.help:
        given.overrides = whole_laws([quoted(word, given.multirun) for word in given.overrides])
    return given


def key_of(word: str) -> str:
    """The key or group that an override sets."""
    return word.lstrip("+~").partition("=")[0]


def whole_laws(words: Sequence[str]) -> list[str]:
    """The words with a number before each delay law, because Hydra would merge it with the law before it."""
    laws = ("delay.obs={", "delay.act={", "delay.rew={")
    return [new for word in words for new in ([f"{key_of(word)}=0"] * word.startswith(laws) + [word])]


def quoted(word: str, multirun: bool = False) -> str:
    """The word with quotes around the folders that it names, because Hydra reads some names as values."""
    key, equals, value = word.partition("=")
    if key.lstrip("+") not in FOLDERS or not equals or value[:1] in ("'", '"', "") or "${" in value:
        return word
    names = value.split(",") if multirun and not os.path.exists(value) else [value]
    return f"{key}={','.join(_in_quotes(name) for name in names)}"


def _in_quotes(name: str) -> str:
    """A name in single quotes, in which Hydra reads a backslash before a quote or at the end as an escape."""
    if "'" in name or name.endswith("\\"):
        name = name.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{name}'"
