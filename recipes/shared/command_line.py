"""The words of a command line, before Hydra reads them."""

import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

from damian.evaluation.run_record import read_record

CONFIG_DIR = ("--config-dir", "-cd")
"""Hydra's option for a folder with configuration files of one's own."""
_TAKES_VALUE = (*CONFIG_DIR, "--config-path", "-cp", "--config-name", "-cn", "--package", "-p", "--cfg", "-c")
"""Options of Hydra that the next word belongs to."""


def config_dir(words: Sequence[str]) -> str | None:
    """The folder with configuration files of one's own, if one is given."""
    for word, following in pairwise([*words, ""]):
        name, equals, value = word.partition("=")
        if name in CONFIG_DIR:
            return value if equals else following
    return None


def prepared(words: Sequence[str]) -> list[str]:
    """The words with what Hydra needs and a person should not have to write.

    Options may stand anywhere. Folders of runs get quotes if their names contain ``=`` or ``,``, as those
    of a sweep do. A policy that was trained with configuration files of one's own is evaluated with the same
    files.
    """
    folders = [match[1] for word in words if (match := re.fullmatch(r"checkpoint=(.*)", word))]
    words = whole_laws([_quoted(word) for word in _options_first(words)])
    if config_dir(words) is None:
        words = [*(f"--config-dir={folder}" for folder in _config_dirs(folders)), *words]
    return words


def _options_first(words: Sequence[str]) -> list[str]:
    """The words with the options before the overrides, because Hydra wants no option between overrides."""
    options, overrides, takes_next = [], [], False
    for word in words:
        is_option = takes_next or word.startswith("-")
        (options if is_option else overrides).append(word)
        takes_next = not takes_next and word in _TAKES_VALUE
    return options + overrides


def whole_laws(words: Sequence[str]) -> list[str]:
    """The words with a number before each delay law, because Hydra would merge it with the law before it."""
    pairs = [(re.fullmatch(r"(delay\.(?:obs|act|rew))=\{.*", word), word) for word in words]
    return [new for law, word in pairs for new in ([f"{law[1]}=0", word] if law else [word])]


def _quoted(word: str) -> str:
    key, _, value = word.partition("=")
    is_folder = key in ("checkpoint", "resume") and re.search(r"[=,]", value) and Path(value).is_dir()
    return f"{key}='{value}'" if is_folder else word


def _config_dirs(folders: Sequence[str]) -> Iterator[str]:
    """The folders with configuration files that runs were trained with."""
    for folder in map(Path, folders):
        used = read_record(folder).get("config_dir")
        if used and Path(used).is_dir():
            yield used
