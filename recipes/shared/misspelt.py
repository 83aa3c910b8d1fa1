"""Answers to settings and options that do not exist: one line that names the nearest one, or its new name."""

import difflib
import re
import sys
from collections.abc import Sequence

from .command_line import CONFIG_DIR, config_dir
from .known_settings import groups, known_settings

RENAMED = {
    "task": "reward",
    "algo": "learner",
    "mappo": "learner",
    "sac": "learner",
    "usecase": "scenario=paper/usecase1 or paper/usecase2, not usecase",
    "delaybench": "scenario=delaybench/tracking and the like, not delaybench",
    "region.situations": "region.initial_conditions",
}
"""Keys and groups of damian 0.1, and those that replaced them."""
_OWN_FILES = (*CONFIG_DIR, "--config-path", "-cp")
"""Options of Hydra with which a user adds configuration files of his own."""

_programs: list[str] = ["train"]
"""Programs whose keys are suggested for a misspelt key, the running one first."""


def set_program(program: str) -> None:
    """Set the running program (a key of ``SCHEMAS``), whose keys are suggested for a misspelt key."""
    _programs[:] = dict.fromkeys([program, "train"])
    _learner_keys.clear()


_learner_keys: list[str] = []
"""Keys of a learner of the user's own, if one is chosen."""


def set_learner_keys(keys: Sequence[str]) -> None:
    """Set the keys of a learner of the user's own, which are suggested for a misspelt key of it."""
    _learner_keys[:] = keys


def check_words(program: str, words: Sequence[str]) -> str | None:
    """What is wrong with the keys and options of a command line, as far as a quick look can tell.

    Args:
        program: a key of ``SCHEMAS``.
        words: the command line after the program's name.

    Returns:
        One line, or None: then Hydra and the settings' own checks decide.
    """
    set_program(program)
    known, options = known_settings(program), groups(config_dir(words))
    own_files = any(word.startswith(_OWN_FILES) for word in words)
    own_learner = own_files or any(re.match(r"learner=.*:", word) for word in words)
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not re.fullmatch(r"\w[\w.]*", key) or key.startswith("hydra"):
            continue
        if key in options:
            plain = re.fullmatch(r"[\w/,]+", value) and not own_files
            missing = [
                name for name in value.split(",") if name not in options[key] and name not in ("null", "")
            ]
            if plain and missing and not re.fullmatch(r"[\d,.]+", value):
                return no_such_option(key, missing[0])
        elif not _is_known(key, known) and not (own_learner and key.startswith("learner.")):
            return no_such_key(key)
    return None


def _is_known(key: str, known: dict) -> bool:
    """Whether a setting exists, or lies below one whose keys are not declared."""
    parts = key.split(".")
    above = (".".join(parts[:n]) for n in range(1, len(parts)))
    return key in known or any(name in known and known[name].is_open for name in above)


def no_such_option(group: str, option: str) -> str:
    """The message for an unknown option of a group, or for an unknown group."""
    options = groups(config_dir(sys.argv)).get(group)
    return f"{group}: {option} is not one of {', '.join(options)}" if options else no_such_key(group)


def no_such_key(key: str) -> str:
    """The message for an unknown key, with the nearest known key."""
    if re.match(r"delay\.(obs|act|rew)\.", key):
        return f"{key}: no such key of the chosen delay law; to write another law, choose delay=none first"
    group = key.partition(".")[0]
    renamed = RENAMED.get(key, RENAMED.get(group))
    if renamed:
        return f"{key}: no such key; since damian 0.2 it is {renamed}"
    own = _learner_keys if group == "learner" else []
    known = [own] if own else [[*known_settings(name)] for name in _programs]
    matches = (difflib.get_close_matches(key, keys, n=1, cutoff=0.75) for keys in known)
    nearest = next(filter(None, matches), [])
    if key in nearest:  # another learner has it
        return f"{key}: no such key of the chosen learner"
    return f"{key}: no such key" + "".join(f"; did you mean {name}?" for name in nearest)
