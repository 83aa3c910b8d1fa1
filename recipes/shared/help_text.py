"""What ``--help`` prints: a page on a program, or the meaning of settings and groups."""

import ast
import itertools
import re
from collections.abc import Sequence
from pathlib import Path

from omegaconf import OmegaConf

from damian.common.text_files import read_text

from .known_settings import CONF, RECIPES, default_options, groups, known_settings
from .misspelt import no_such_key


def help_text(recipe: str, program: str, keys: Sequence[str] = (), own_folder: str | None = None) -> str:
    """What ``--help`` prints: a page on the program, or the meaning of settings and groups.

    Args:
        recipe: name of a file of recipes/.
        program: one of ``SCHEMAS``.
        keys: groups, and dotted keys of settings or sections, to explain.
        own_folder: a folder with configuration files of the user's own.
    """
    if keys:
        return "\n".join(_explained(program, key, own_folder) for key in keys)
    if recipe == "train":
        return str(OmegaConf.load(Path(CONF, "hydra", "help", "train.yaml")).template)
    text = ast.get_docstring(ast.parse((RECIPES / f"{recipe}.py").read_text())) or ""
    return f"{text}\n\nSettings: damian train --help, damian {recipe} --help KEY."


def _explained(program: str, key: str, own_folder: str | None) -> str:
    found = [*_options(program, key, own_folder), *_meaning(program, key)]
    return "\n".join(found or [no_such_key(key, program)])


def _options(program: str, group: str, own_folder: str | None) -> list[str]:
    """How to choose an option of a group, with all options, the default one in brackets; or nothing."""
    if group not in default_options(program):
        return []
    default, options = default_options(program)[group], groups(own_folder)[group]
    shown = [f"[{option}]" if option == default else option for option in options]
    said = {option: _comment(group, option, own_folder) for option in options}
    lines = [f"    {option}: {text}" for option, text in said.items() if text]
    return [f"choose one with {group}=OPTION: {', '.join(shown)}", *lines]


def _comment(group: str, option: str, own_folder: str | None) -> str:
    """What the comment at the top of an option's file says, without the command in it."""
    files = (Path(root, group, f"{option}.yaml") for root in filter(None, (own_folder, CONF)))
    text = next((read_text(file) for file in files if file.is_file()), "")
    lines = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    comment = [line.lstrip("# ") for line in lines]
    words = (re.sub(r"^@package.*|^(cd \S+; )?damian .*?(  +|$)", "", line) for line in comment)
    return " ".join(filter(None, (re.sub(r"^\((.*)\)$", r"\1", line) for line in words)))


def _meaning(program: str, key: str) -> list[str]:
    """Key, type, default and meaning of a setting, or of all settings of a section."""
    chosen = {k: s for k, s in known_settings(program).items() if k == key or k.startswith(f"{key}.")}
    lines = []
    for name, setting in chosen.items():
        default = f" = {setting.default}" if setting.default else ""
        lines += [f"{name}: {setting.kind}{default}", *(f"    {line}" for line in setting.text.splitlines())]
    return lines
