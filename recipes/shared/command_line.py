"""The words of a command line, before Hydra reads them."""

import os
import re
import shlex
import sys
from argparse import Action, ArgumentDefaultsHelpFormatter, ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException

from damian.common.errors import RUN_ERROR, InputError, RunError
from damian.common.text_files import one_line, show
from damian.runs.run_record import read_record

from .known_settings import RECIPES


@contextmanager
def exits_with_one_line() -> Iterator[None]:
    """End the program with one line on stderr where wrong input is found inside, or a file cannot be written.

    The exit code is 2, or ``RUN_ERROR``.
    """
    try:
        yield
    except (InputError, RunError) as error:
        print(f"error: {one_line(str(error))}", file=sys.stderr)
        sys.exit(2 if isinstance(error, InputError) else RUN_ERROR)


class _WithDefaults(ArgumentDefaultsHelpFormatter):
    """Names the default of each option that has one."""

    def _get_help_string(self, action: Action) -> str | None:
        return action.help if action.default in (None, False) else super()._get_help_string(action)


class Parser(ArgumentParser):
    """Raises an ``InputError`` instead of printing its usage; its help names the defaults."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, formatter_class=_WithDefaults, **options)

    def error(self, message: str) -> NoReturn:
        raise InputError(message)


def parsed(words: Sequence[str]) -> Namespace:
    """The options and the ``overrides`` of a command line, as Hydra's own parser reads them.

    Hydra accepts no option between overrides; here options may stand anywhere.

    Raises:
        InputError: an option does not exist, or lacks its value.
    """
    parser = get_args_parser()
    parser.error = _refuse
    return parser.parse_intermixed_args(list(words))


def own_folder() -> str | None:
    """The folder with configuration files of the user's own, if this process was given one."""
    try:
        return parsed(sys.argv[1:]).config_dir
    except InputError:  # a script with options of its own
        return None


def _refuse(message: str) -> NoReturn:
    raise InputError(message)


def prepared(words: Sequence[str]) -> list[str]:
    """The words with what Hydra needs and a person should not have to write.

    Options come first. Names of folders get quotes if Hydra would not read them as a name. A policy that was
    trained with configuration files of one's own is evaluated with the same files.

    Raises:
        InputError: an option is wrong, or policies were trained with different folders of files.
    """
    options = vars(parsed(words))
    for word in options["overrides"]:
        if not word.lstrip("+~").partition("=")[0].partition("@")[0].strip():
            raise InputError(f"{word!r}: this word is not of the form KEY=VALUE")
        if "\0" in word:
            raise InputError(f"{word!r}: a NUL byte is not text")
        if re.fullmatch(r"hydra\.(run|sweep)\.dir=(['\"]?)\s*\2", word):
            raise InputError(f"{word.partition('=')[0]}: it is empty: name a folder, or leave it out")
        if named := re.fullmatch(r"(hydra\.(?:run|sweep)\.dir)=(['\"]?)(.+)\2", word):
            for path in (Path(named[3]), *Path(named[3]).parents):
                if os.path.isfile(path):
                    raise InputError(f"{named[1]}: {show(str(path))} is a file: name a folder")
        _check_folder(word)
    overrides = whole_laws([_quoted(word) for word in options.pop("overrides")])
    options["config_dir"] = options["config_dir"] or _config_dir(overrides)
    given = ((f"--{name.replace('_', '-')}", value) for name, value in options.items() if value)
    return [*(name if value is True else f"{name}={value}" for name, value in given), *overrides]


_typed: list[str] = []
"""The command line as it was typed; empty in a worker process of a comparison."""


SECRET = "token"
"""Key of the setting that is a password."""


def is_secret(word: str) -> bool:
    """Does an override set a password, however it is written?"""
    return word.lstrip("+~").partition("=")[0] == SECRET


def remember_words() -> None:
    """Remember the command line as it was typed, before it is prepared for Hydra."""
    _typed[:] = sys.argv


def typed_words() -> list[str]:
    """The words of the command line as they were typed, without the name of the program."""
    return (_typed or sys.argv)[1:]


def typed_command() -> str:
    """The command line as it was typed, without the password of a service, which no file should keep."""
    return command([f"{SECRET}=..." if is_secret(word) else word for word in typed_words()])


def command(words: Sequence[str]) -> str:
    """The command that runs this program with words, to be typed in a shell."""
    program = Path(sys.argv[0])
    if program.suffix == ".py":
        is_ours = (RECIPES / program.name).exists()
        return shlex.join([*(["damian", program.stem] if is_ours else ["python", str(program)]), *words])
    return f"{program.name} {shlex.join(words)}".strip()


def _check_folder(word: str) -> None:
    """Refuse a run folder that the file system cannot look up, because its name is too long for instance."""
    key, _, folder = word.lstrip("+").partition("=")
    try:
        if key in ("checkpoint", "resume"):
            os.stat(folder)
    except (FileNotFoundError, NotADirectoryError):
        return  # it may be quoted, or several in a sweep
    except (OSError, ValueError) as error:
        raise InputError(f"{key}: {show(folder)}: {getattr(error, 'strerror', error)}") from None


def whole_laws(words: Sequence[str]) -> list[str]:
    """The words with a number before each delay law, because Hydra would merge it with the law before it."""
    pairs = [(re.fullmatch(r"(delay\.(?:obs|act|rew))=\{.*", word), word) for word in words]
    return [new for law, word in pairs for new in ([f"{law[1]}=0", word] if law else [word])]


def _quoted(word: str) -> str:
    """The word with quotes around the folders that it names, where Hydra needs them."""
    key, _, value = word.partition("=")
    if re.fullmatch(r"\+*(checkpoint|resume)", key):
        names = [value] if os.path.exists(value) else value.split(",")  # several in a sweep
        if all(map(os.path.exists, names)):
            return f"{key}={','.join(map(_quoted_name, names))}"
    if key in ("hydra.run.dir", "hydra.sweep.dir") and _values(word) is None:
        return f"{key}={_quoted_name(value)}"
    return word


def _quoted_name(name: str) -> str:
    is_plain = (
        re.fullmatch(r"[A-Za-z_][\w./-]*|[./][\w./-]+", name, re.ASCII) and name.lower() not in NO_NAMES
    )
    return name if is_plain else QuotedString(name, Quote.single).with_quotes()


NO_NAMES = ("null", "true", "false", "nan", "inf")
"""Names that Hydra would read as values."""


def _values(word: str) -> list[str] | None:
    """The values of an override, several in a sweep; None if Hydra cannot read it."""
    try:
        override = OverridesParser.create().parse_override(word)
        found = override.sweep_iterator() if override.is_choice_sweep() else [override.value()]
        return [each.text if isinstance(each, QuotedString) else str(each) for each in found]
    except HydraException:
        return None


def _config_dir(overrides: Sequence[str]) -> str | None:
    """The folder with configuration files that the policies on the command line were trained with.

    Raises:
        InputError: there are several such folders.
    """
    policies = [word for word in overrides if re.match(r"\+*checkpoint=", word)]
    folders = [Path(folder) for word in policies for folder in _values(word) or ()]
    records = [read_record(folder.parent if folder.suffix == ".pt" else folder) for folder in folders]
    used = [record.get("config_dir") for record in records]
    used_folders = sorted({folder for folder in used if isinstance(folder, str) and os.path.isdir(folder)})
    if len(used_folders) > 1:
        names = " and ".join(used_folders)
        raise InputError(
            f"checkpoint: the policies were trained with the configuration files of {names}: "
            "evaluate them one after the other, or choose one folder with --config-dir"
        )
    return used_folders[0] if used_folders else None
