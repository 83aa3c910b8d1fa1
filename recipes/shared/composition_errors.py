"""Hydra's, OmegaConf's and YAML's errors as one line that names the key, the value and the remedy."""

import re
import sys

from hydra.errors import HydraException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException
from yaml import MarkedYAMLError, YAMLError
from yaml.reader import ReaderError

from damian.common import text_files
from damian.common.errors import InputError

from .command_line import NO_NAMES, own_folder
from .known_settings import default_options, groups
from .misspelt import RENAMED, no_such_key, no_such_option

COMPOSITION_ERRORS = (
    HydraException,
    OmegaConfBaseException,
    YAMLError,
    ValueError,
    TypeError,
    OSError,
    RecursionError,
)
"""What Hydra raises for overrides and files that it cannot compose."""
QUOTES = {
    r"mismatched input '='|no viable alternative at input '\[\w+='": (
        "a value with = in it needs quotes, such as \"overrides=['frames=1000','worlds=8']\""
    ),
    r"input '[^']*\{|LexerNoViableAltException: .*\{": (
        'a mapping needs quotes, such as "delay.obs={law: uniform, low: 3s, high: 7s}"'
    ),
    "": "put quotes around a value with special characters, as in \"KEY='VALUE'\"",
}
"""What to do about a value that Hydra cannot read, by a pattern of Hydra's message; the first that fits."""
REMEDIES = {
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
    """The deepest cause of an error on one printable line, without Hydra's lines of types, paths and hints.

    Args:
        error: what was raised.
        program: one of ``SCHEMAS``, whose settings were composed.
    """
    return text_files.one_line(_cause(error, program))


def _cause(error: BaseException, program: str) -> str:
    if isinstance(error, InputError):  # it says what is wrong already
        return str(error)
    outer = str(error)
    while isinstance(error.__cause__, OmegaConfBaseException):
        error = error.__cause__
    if isinstance(error, MarkedYAMLError) and (mark := error.problem_mark):
        return f"{mark.name}, line {mark.line + 1}, column {mark.column + 1}: {error.problem}"
    if isinstance(error, ReaderError):
        return f"{error.name}, character {error.position + 1}: {error.reason}"
    if isinstance(error, RecursionError):
        longest = max(sys.argv[1:], key=len, default="")
        return f"{text_files.show(longest)}: a word or a file of the settings is nested too deeply"
    text, _, _ = _INSTANCE.sub(r"\1: ", str(error)).partition("Config search path")
    found = _about_words(text, program) or _about_key(text, error, outer, program)
    return found or _unreadable(error) or _plain(text, error, outer)


def _unreadable(error: BaseException) -> str | None:
    """The message for a word that Hydra's grammar does not allow."""
    if not isinstance(error, OverrideParseException):
        return None
    key, _, value = str(error.override).partition("=")
    remedy = next(remedy for pattern, remedy in QUOTES.items() if re.search(pattern, str(error)))
    return f"{key[:80]}: Hydra cannot read {text_files.show(value)}: {remedy}"


def _about_words(text: str, program: str) -> str | None:
    """The message for words that Hydra cannot read, and for groups and options that do not exist."""
    for pattern, remedy in REMEDIES.items():
        if match := re.search(pattern, text):
            return match.expand(remedy)
    if option := re.search(r"Could not find '([\w-]+)/(\S+)'", text):
        return no_such_option(option[1], option[2], own_folder())
    if group := re.search(r"Could not override '([\w/]+)'\. No match in the defaults list", text):
        return no_such_key(group[1], program)
    return _about_unnamed(text)


def _about_unnamed(text: str) -> str | None:
    """The message for Python's errors inside Hydra; they name no word, but the command line tells which."""
    if "Exceeds the limit (4300 digits)" in text:
        long = (word for word in sys.argv[1:] if re.search(r"\d{4300}", word))
        key = next(long, "").partition("=")[0] or "a number in a configuration file"
        return f"{key}: it has more than 4300 digits"
    if index := re.search(r"invalid literal for int\(\) with base 10: '(.*)'$", text):
        keys = (word.partition("=")[0].lstrip("+~") for word in sys.argv[1:])
        key = next((key for key in keys if key.endswith(f".{index[1]}")), index[1])
        return f"{key}: no such key: it is below a list, whose entries are counted from 0"
    no_name = r"override (deletion value )?must be a string|type '\w+' is not iterable|can only concatenate"
    if re.search(no_name, text):
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
    if key and (value := re.search(r"Value '(\S+)' of type 'float' could not be converted to Int", text)):
        number = float(value[1])
        whole = f"; write {number:.0f}" if number.is_integer() else ""
        return f"{key[1]}: {value[1]} is not written as a whole number{whole}"
    return None


def _plain(text: str, error: BaseException, outer: str) -> str:
    """A message with its key in front, and without OmegaConf's and Hydra's lines of types and hints."""
    key, tails = _KEY.search(text), ("full_key", "reference_type", "object_type", "Set the env", "See https")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    first, *more = [line for line in lines if not line.startswith(tails)] or [type(error).__name__]
    message = " ".join([first, ", ".join(more).replace(":,", ":")]).strip()
    given = re.search(r"Error merging override [+~]*([\w.]+)=", outer)
    if key and given and f".{key[1]}." in f".{given[1]}.":
        return f"{given[1]}: {message}"  # OmegaConf names only the last part of a key in a mapping
    return f"{key[1]}: {message}" if key else message


def foreign_cause(error: BaseException) -> BaseException | None:
    """The exception of other code, such as a component of the user's own, that an error stands for."""
    known = (HydraException, OmegaConfBaseException, YAMLError, RecursionError, InputError)
    if _INSTANCE.match(str(error)):
        cause = error.__context__  # OmegaConf hides it
    elif isinstance(error, InputError):
        cause = error.__cause__
    else:
        cause = (
            None
            if isinstance(error, OSError | OverrideParseException) or _about_words(str(error), "train")
            else error
        )
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
    """Does an override set a group to no word, which Hydra refuses without naming the group?"""
    group, equals, value = override.lstrip("+~").partition("=")
    is_name = re.fullmatch(r"[^\W\d][\w/.:-]*", value) and value.lower() not in NO_NAMES
    return bool(equals) and not is_name and (group in RENAMED or group in groups())


def _not_an_option(override: str) -> str:
    group, _, option = override.lstrip("+~").partition("=")
    return no_such_option(group, option)
