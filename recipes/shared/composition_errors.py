"""Hydra's and OmegaConf's errors as one line that names the key, the value and the remedy."""

import re
import sys

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from .known_settings import groups
from .misspelt import RENAMED, no_such_key, no_such_option

COMPOSITION_ERRORS = (HydraException, OmegaConfBaseException, ValueError, TypeError, OSError)
"""What Hydra raises for overrides that it cannot compose."""


def one_line(error: BaseException) -> str:
    """The deepest cause of an error on one line, without Hydra's lines of types, paths and hints."""
    while isinstance(error.__cause__, OmegaConfBaseException):
        error = error.__cause__
    text, _, _ = str(error).partition("Config search path")
    if re.search(r"mismatched input '='|no viable alternative at input '\[\w+='", text):
        return "a value with = in it needs quotes, such as \"overrides=['frames=1000','worlds=8']\""
    if option := re.search(r"Could not find '([\w-]+)/(\S+)'", text):
        return no_such_option(*option.groups())
    if "Config group override must be a string" in text:
        return next(map(_not_an_option, filter(_gives_group_no_name, sys.argv[1:])), text)
    key = re.search(r"full_key: (\S+)", text)
    if key and re.search(r"Key '.*' (is )?not in ", text):
        return no_such_key(key[1])
    tails = ("full_key", "reference_type", "object_type", "Set the env")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    first, *more = [line for line in lines if not line.startswith(tails)] or [type(error).__name__]
    message = " ".join([first, ", ".join(more).replace(":,", ":")]).strip()
    return f"{key[1]}: {message}" if key else message


def _gives_group_no_name(override: str) -> bool:
    """Does an override set a group to a number or null, which Hydra refuses without naming the group?"""
    match = re.fullmatch(r"\+?(\w+)=([\d,.]+|null)", override)
    return match is not None and (match[1] in RENAMED or match[1] in groups())


def _not_an_option(override: str) -> str:
    group, _, option = override.lstrip("+").partition("=")
    return no_such_option(group, option)
