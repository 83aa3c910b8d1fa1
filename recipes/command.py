"""The command ``damian``: runs one of the programs of this folder, as in ``damian train agents=3``.

Help and wrong words are answered before TorchRL, which takes seconds to import, is loaded.
"""

import io
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from damian.common.errors import InputError
from damian.common.text_files import one_line

from .known import PROGRAMS, check_words, help_text

FOLDERS = {"export": "checkpoint={}", "results": "folders=[{}]"}
"""The setting that plain words mean, of programs whose main setting is a folder."""
MORE = "damian PROGRAM --help explains a program's settings, damian --version prints the version."


def main(words: Sequence[str] | None = None) -> None:
    """Run the program that the first word names with the other words."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(
            stream, io.TextIOWrapper
        ):  # a pipe of Windows may be unable to carry every letter
            stream.reconfigure(errors="backslashreplace")
    # Threads that wait for each other soon sleep: where other programs run, a training whose
    # threads keep spinning takes several times as long. OpenMP reads this when torch is loaded.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    # Compiled kernels: torch's own choice is a temporary folder, which the next boot, or job,
    # lacks.
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(Path(caches, "torchinductor")))
    name, *words = (sys.argv[1:] if words is None else words) or ["--help"]
    if name in ("-h", "--help"):
        print(usage())
    elif name == "--version":
        print(import_module("damian").__version__)
    else:
        try:
            checked = _checked(name, words)
            if checked is None:
                return
            program = import_module(f".{name}", __package__)
        except (
            InputError
        ) as error:  # also a package that the program needs and that is not installed
            print(f"error: {one_line(str(error))}", file=sys.stderr)
            sys.exit(2)
        sys.argv = [f"damian {name}", *checked]  # the program's own command line, which Hydra reads
        program.main()


def _checked(name: str, words: list[str]) -> list[str] | None:
    """The words for a program; None if it was asked for help, which is printed."""
    if name not in PROGRAMS:
        raise InputError(f"{name}: no such program; the programs are {', '.join(PROGRAMS)}")
    options = [
        word for word in words if word.startswith("-") or ("=" not in word and word[:1] != "~")
    ]
    rest = [word for word in words if word not in options]
    before = dict(zip(options, ["", *options], strict=False))
    plain = [word for word in options if word[:1] != "-" and before[word][:1] != "-"]
    if {"-h", "--help"} & {*options}:
        print(help_text(name, [word for word in options if word[:1] != "-"]))
        return None
    if plain and name in FOLDERS:
        options = [word for word in options if word not in plain]
        rest.append(FOLDERS[name].format(",".join(f"'{word}'" for word in plain)))
    elif plain:
        raise InputError(f"{plain[0]}: this word is not of the form KEY=VALUE")
    if {"-m", "--multirun"} & {*options} and name in ("compare", *FOLDERS):
        raise InputError(f"-m: not with damian {name}, which has many runs anyway")
    if not any(word.startswith(("--config-dir", "-cd")) for word in options):  # it may have any key
        check_words(name, rest)
    return [*options, *rest]  # Hydra wants options first


def usage() -> str:
    """The programs, one per line."""
    width = max(map(len, PROGRAMS))
    programs = [f"  {name:{width}}  {what}" for name, what in PROGRAMS.items()]
    return "\n".join(["damian PROGRAM [GROUP=OPTION] [KEY=VALUE] ...", "", *programs, "", MORE])
