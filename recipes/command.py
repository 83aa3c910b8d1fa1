"""The command ``damian``: runs one of the programs of this folder, as in ``damian train agents=3``.

Help and wrong words are answered before TorchRL, which takes seconds to import, is loaded.
"""

import io
import os
import sys
from collections.abc import Sequence
from importlib import import_module

from damian.common.errors import InputError
from damian.common.text_files import one_line

from .known import check_words, help_text, parsed

PROGRAMS = {
    "train": "train UAVs with MAPPO or SAC, then evaluate the policy beside a random and a scripted one",
    "evaluate": "evaluate a trained policy, also in another scenario or under other delays",
    "compare": "train and evaluate several methods with several seeds, and compare them with intervals",
    "tune": "search for better settings of a learner with Optuna",
    "fly": "fly episodes, and keep or replay them as files, films, figures and pages",
    "advise": "advise real UAVs: from what they report, where each should land next",
    "export": "export a policy that flies without damian: damian export RUN",
    "results": "show the results in a folder as one table: damian results FOLDER",
}
"""What each program does, by its name; the program is the module of this name."""
SETTINGS = {name: name for name in PROGRAMS if name not in ("export", "results")} | {"evaluate": "train"}
"""Whose settings each program has; the others take a folder."""


def main(words: Sequence[str] | None = None) -> None:
    """Run the program that the first word names with the other words."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a pipe of Windows may be unable to carry every letter
            stream.reconfigure(errors="backslashreplace")
    # Threads that wait for each other soon sleep: where other programs run, a training whose threads keep
    # spinning takes several times as long. OpenMP reads this when torch is loaded.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    name, *words = (sys.argv[1:] if words is None else words) or ["--help"]
    if name in ("-h", "--help"):
        _show(usage())
    elif name == "--version":
        print(import_module("damian").__version__)
    else:
        try:
            _run(name, words)
        except InputError as error:
            print(f"error: {one_line(str(error))}", file=sys.stderr)
            sys.exit(2)


def _run(name: str, words: Sequence[str]) -> None:
    if name not in PROGRAMS:
        raise InputError(f"{name}: no such program; the programs are {', '.join(PROGRAMS)}")
    sys.argv = [f"damian {name}", *words]
    if name not in SETTINGS:  # it takes a folder
        if {"-h", "--help"} & {*words}:
            _show(program_help(name))
        else:
            with import_module(".cli", __package__).one_line_errors():
                import_module(f".{name}", __package__).run()
        return
    program, given = SETTINGS[name], parsed(words)
    if given.help:
        keys = [word for word in given.overrides if "=" not in word]
        _show(program_help(name, keys, given.config_dir))
        return
    check_words(program, given.overrides, given.config_dir)
    cli = import_module(".cli", __package__)  # with Hydra, which takes a while to import
    with cli.one_line_errors():
        found = cli.check(program, given)
        if given.cfg:
            _show(found)
            return
    import_module(f".{name}", __package__).run()


def _show(text: str) -> None:
    """Print, also to a reader that stops early, as in ``damian train --help learner | head``."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or the exit would write once more


def usage() -> str:
    """The programs, one per line."""
    width = max(map(len, PROGRAMS))
    programs = [f"  {name:{width}}  {what}" for name, what in PROGRAMS.items()]
    return "\n".join(["damian PROGRAM [GROUP=OPTION] [KEY=VALUE] ...", "", *programs, "", MORE])


def program_help(name: str, keys: Sequence[str] = (), own_folder: str | None = None) -> str:
    """What ``damian NAME --help`` prints."""
    if name not in SETTINGS:
        return import_module(f".{name}", __package__).__doc__ or ""
    return help_text(name, SETTINGS[name], keys, own_folder)


MORE = "damian PROGRAM --help explains a program's settings, damian --version prints the version."
