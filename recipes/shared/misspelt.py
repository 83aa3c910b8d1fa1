"""Answers to settings and options that do not exist: one line that names the nearest one, or its new name."""

import difflib
import re
from collections.abc import Sequence
from pathlib import Path

from .command_line import parsed
from .known_settings import default_options, groups, known_settings

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


def check_words(program: str, words: Sequence[str]) -> str | None:
    """What is wrong with the keys and options of a command line, as far as a quick look can tell.

    Args:
        program: a key of ``SCHEMAS``.
        words: the command line after the program's name.

    Returns:
        One line, or None: then Hydra and the settings' own checks decide.

    Raises:
        InputError: an option such as ``--config-dir`` is misspelt, or lacks its value.
    """
    given = parsed(words)
    pairs = [word.lstrip("+").partition("=")[::2] for word in given.overrides]
    if given.config_name or given.config_path or any(key == "hydra.searchpath" for key, _ in pairs):
        return None  # these settings may be others
    other_learner = given.config_dir or any(
        key in ("checkpoint", "resume") or (key == "learner" and ":" in value) for key, value in pairs
    )
    open_sections = {*(groups(given.config_dir).keys() - groups()), *["learner"] * bool(other_learner)}
    for word in given.overrides:
        key, equals, value = word.partition("=")
        if not equals or not re.fullmatch(r"\w[\w.]*", key) or key.startswith("hydra"):
            continue
        if key in default_options(program):
            unknown = not given.config_dir and _unknown_option(value, groups()[key])
            if unknown:
                return no_such_option(key, unknown)
        elif not (_is_known(key, program) or key.partition(".")[0] in open_sections):
            return no_such_key(key, program, value)
    return None


def _unknown_option(value: str, options: Sequence[str]) -> str | None:
    """The first of some options, several in a sweep, that a group does not have."""
    if not re.fullmatch(r"[\w/,]+", value) or re.fullmatch(r"[\d,.]+", value):
        return None  # Hydra decides
    return next((name for name in value.split(",") if name not in (*options, "null", "")), None)


def _is_known(key: str, program: str) -> bool:
    """Whether a program has a setting, or one above it whose keys are not declared."""
    parts, known = key.split("."), known_settings(program)
    above = (".".join(parts[:n]) for n in range(1, len(parts)))
    return key in known or any(name in known and known[name].is_open for name in above)


def no_such_option(group: str, option: str, own_folder: str | None = None) -> str:
    """The message for an unknown option of a group, or for an unknown group."""
    options = groups(own_folder).get(group)
    if not options:
        return no_such_key(group)
    plain = not own_folder and re.fullmatch(r"[\w/-]+", option)
    here = sorted(Path().glob(f"*/{group}/{option}.yaml")) if plain else []
    hint = "".join(f"; for {path} add --config-dir={path.parts[0]}" for path in here[:1])
    return f"{group}: {option} is not one of {', '.join(options)}{hint}"


def no_such_key(key: str, program: str = "train", value: str = "...", beside: Sequence[str] = ()) -> str:
    """The message for an unknown key, with the nearest known key.

    Args:
        key: the dotted key.
        program: one of ``SCHEMAS``.
        value: the value that was given.
        beside: the keys that its section has, where they are known; a learner of one's own has its own keys.
    """
    if re.match(r"delay\.(obs|act|rew)\.", key):
        return f"{key}: no such key of the chosen delay law; to write another law, choose delay=none first"
    group = key.partition(".")[0]
    renamed = RENAMED.get(key, RENAMED.get(group))
    if renamed:
        return f"{key}: no such key; since damian 0.2 it is {renamed}"
    if group == "learner" and key in known_settings("train"):  # another learner has it
        return f"{key}: no such key of the chosen learner"
    if program == "compare" and (key in default_options("train") or _is_known(key, "train")):
        return f"{key}: it is a setting of the runs; all of them get it by \"overrides=['{key}={value}']\""
    known = [known_settings(name) for name in dict.fromkeys([program, "train"])]
    names = [beside] if group == "learner" and beside else known
    matches = (difflib.get_close_matches(key, keys, n=1, cutoff=0.75) for keys in names)
    nearest = next(filter(None, matches), [])
    return f"{key}: no such key" + "".join(f"; did you mean {name}?" for name in nearest)
