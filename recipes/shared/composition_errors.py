"""Hydra's, OmegaConf's and YAML's errors as one line that names the key, the value and the remedy."""

import re
import sys

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException
from yaml import MarkedYAMLError

from damian.common.errors import InputError

from .command_line import own_folder
from .known_settings import default_options, groups
from .misspelt import RENAMED, no_such_key, no_such_option

COMPOSITION_ERRORS = (HydraException, OmegaConfBaseException, MarkedYAMLError, ValueError, TypeError, OSError)
"""What Hydra raises for overrides and files that it cannot compose."""
REMEDIES = {
    r"mismatched input '='|no viable alternative at input '\[\w+='": (
        "a value with = in it needs quotes, such as \"overrides=['frames=1000','worlds=8']\""
    ),
    r"input '[^']*\{|LexerNoViableAltException: .*\{": (
        'a mapping needs quotes, such as "delay.obs={law: uniform, low: 3s, high: 7s}"'
    ),
    r"Error parsing override '(.*)'\nmissing EQUAL": (
        r"\1: this word is not of the form KEY=VALUE; a value with spaces needs quotes"
    ),
    r"Ambiguous value for argument '(.*?)=(.*)'": (
        r"\1: several values need -m, which makes a run of each; a list needs brackets: \1=[\2]"
    ),
}
"""What to write instead of words that Hydra cannot read, by a pattern of Hydra's message."""

_KEY = re.compile(r"full_key: (\S+)")
_INSTANCE = re.compile(r"Could not create instance of `(\w+)`: ")
_LIST = r"is not a ListConfig|merge DictConfig with ListConfig[^=]*reference_type=List|type hint 'typing.List"


def one_line(error: BaseException, program: str = "train") -> str:
    """The deepest cause of an error on one line, without Hydra's lines of types, paths and hints.

    Args:
        error: what was raised.
        program: one of ``SCHEMAS``, whose settings were composed.
    """
    outer = str(error)
    while isinstance(error.__cause__, OmegaConfBaseException):
        error = error.__cause__
    if isinstance(error, MarkedYAMLError) and (mark := error.problem_mark):
        return f"{mark.name}, line {mark.line + 1}, column {mark.column + 1}: {error.problem}"
    text, _, _ = _INSTANCE.sub(r"\1: ", str(error)).partition("Config search path")
    return _about_words(text, program) or _about_key(text, error, outer, program) or _plain(text, error)


def _about_words(text: str, program: str) -> str | None:
    """The message for words that Hydra cannot read, and for groups and options that do not exist."""
    for pattern, remedy in REMEDIES.items():
        if match := re.search(pattern, text):
            return match.expand(remedy)
    if option := re.search(r"Could not find '([\w-]+)/(\S+)'", text):
        return no_such_option(option[1], option[2], own_folder())
    if group := re.search(r"Could not override '([\w/]+)'\. No match in the defaults list", text):
        return no_such_key(group[1], program)
    if "Config group override must be a string" in text:
        return next(map(_not_an_option, filter(_gives_group_no_name, sys.argv[1:])), None)
    return None


def _about_key(text: str, error: BaseException, outer: str, program: str) -> str | None:
    """The message for a key that does not exist, and for a list that is given as something else."""
    key = _KEY.search(text)
    if key and re.search(r"Key '.*' (is )?not in ", text):
        return _unknown(key[1], text, error, program)
    if key and re.search(_LIST, text):
        given = re.search(r"Error merging override \+*[\w.]+=(.*)", outer)
        return f"{key[1]}: it is a list: [{given[1] if given else '...'}]"
    return None


def _plain(text: str, error: BaseException) -> str:
    """A message with its key in front, and without OmegaConf's and Hydra's lines of types and hints."""
    key, tails = _KEY.search(text), ("full_key", "reference_type", "object_type", "Set the env", "See https")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    first, *more = [line for line in lines if not line.startswith(tails)] or [type(error).__name__]
    message = " ".join([first, ", ".join(more).replace(":,", ":")]).strip()
    return f"{key[1]}: {message}" if key else message


def foreign_cause(error: BaseException) -> BaseException | None:
    """The exception of other code, such as a component of the user's own, that an error stands for."""
    known = (HydraException, OmegaConfBaseException, MarkedYAMLError, InputError)
    if _INSTANCE.match(str(error)):
        cause = error.__context__  # OmegaConf hides it
    elif isinstance(error, InputError):
        cause = error.__cause__
    else:
        cause = None if isinstance(error, OSError) or _about_words(str(error), "train") else error
    return None if isinstance(cause, known) else cause


def _unknown(key: str, text: str, error: BaseException, program: str) -> str:
    """The message for a key that does not exist, on the command line or in a file."""
    file = re.match(r"In '(\S+)':", text)
    if file and key in default_options(program):
        return f"{key}: begin {file[1]}.yaml with the line # @package _global_"
    section, _, _ = key.rpartition(".")
    node = getattr(error, "parent_node", None)
    return no_such_key(key, program, beside=[f"{section}.{name}" for name in node or ()])


def _gives_group_no_name(override: str) -> bool:
    """Does an override set a group to a number or null, which Hydra refuses without naming the group?"""
    match = re.fullmatch(r"\+?(\w+)=([\d,.]+|null)", override)
    return match is not None and (match[1] in RENAMED or match[1] in groups())


def _not_an_option(override: str) -> str:
    group, _, option = override.lstrip("+").partition("=")
    return no_such_option(group, option)
