"""What the programs share: schemas, options of the user's own, checked settings, and errors in one
line.

Nothing here imports torch. A program is a function that takes what Hydra has composed
(``program``); ``shared/runs.py`` starts its work in the run folder.
"""

import functools
import os
import re
import shlex
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

os.environ.setdefault(
    "HYDRA_FULL_ERROR", "1"
)  # Hydra raises its errors, and ``one_line_errors`` prints them

import hydra
import yaml
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from damian.common import checks
from damian.common.errors import RUN_ERROR, InputError, RunError
from damian.common.fields import filled, set_at, value_at
from damian.common.text_files import one_line
from damian.learners.config import LEARNERS
from damian.runs.processes import end_interrupted

from .known import CONF, MAPS, SCHEMAS, described, key_of, known_settings, no_such_key

Work = Callable[[Any, Path], None]
"""The work of a program: takes checked settings and the run folder to fill."""
ERRORS = (HydraException, OmegaConfBaseException, yaml.YAMLError)
"""What Hydra raises for words and files that it cannot compose."""
EXPECTED = (InputError, RunError, OSError, *ERRORS)
"""What is told in one line."""


def _schema(kind: type) -> DictConfig:
    """The settings of a dataclass at their defaults; mappings take any key, which ``filled``
    checks."""
    found = OmegaConf.create()
    for key, each in described(kind).items():
        if not key.startswith("learner."):  # the group fills it in
            OmegaConf.update(found, key, {} if each.is_section else each.default)
            if each.is_section or isinstance(each.default, dict):
                OmegaConf.set_struct(OmegaConf.select(found, key), False)
    return found


def _register() -> None:
    store = ConfigStore.instance()
    for name, kind in SCHEMAS.items():
        store.store(group="schema", name=name, node=_schema(kind), package="_global_")
    for name in LEARNERS:
        store.store(group="schema/learner", name=name, node=_schema(LEARNERS.get(name, "learner")))


_register()


OWN = {"learner": "name", "model": "name", "region": "kind", "motion": "kind"}
"""Groups whose option may be code of the user's own, and the setting that names it."""


def _register_own(words: Sequence[str]) -> None:
    """Make each ``learner=package.module:Name`` and ``region=map.kml`` of a command line an option
    of its group."""
    store = ConfigStore.instance()
    for word in words:
        group, _, names = word.partition("=")
        for name in names.split(",") if group in OWN else ():
            if group == "region" and name.endswith(MAPS):
                folder, _, file = name.rpartition("/")
                node = {"kind": "geojson", "path": name}
                place = f"{group}/{folder.strip('/')}".strip("/")  # Hydra joins what stands between
                store.store(group=place, name=file, node=node, package=group)
            elif ":" in name:
                store.store(group=group, name=name, node={OWN[group]: name})


def settings(*words: str, program: str = "train") -> Any:
    """The checked settings of a program with these words, for Python programs too."""
    return checked(composed(*words, program=program), words, program)


def composed(*words: str, program: str = "train") -> DictConfig:
    """What Hydra composes from words; in a program of damian with the options of its
    --config-dir."""
    running = GlobalHydra.instance().hydra
    try:
        _register_own(words)
        path = str(running.config_loader.get_search_path()) if running else ""
        if str(CONF) in path or "pkg://damian/conf" in path:
            return compose(program, [*words], return_hydra_config=True)
        GlobalHydra.instance().clear()  # of a Hydra application that calls this
        with initialize_config_dir(str(CONF), version_base=None):
            return compose(program, [*words], return_hydra_config=True)
    except (*ERRORS, ValueError) as error:  # such as a group that is set to a number
        raise InputError(reason(error, program)) from error
    finally:
        GlobalHydra.instance().hydra = running


def checked(given: DictConfig, words: Sequence[str], program: str = "train") -> Any:
    """A composed configuration as settings, whose checks it passes."""
    return filled(SCHEMAS[program], plain(given, words, program))


def plain(given: DictConfig, words: Sequence[str], program: str = "train") -> dict[str, Any]:
    """A composed configuration as plain data.

    A law, or another setting that is one value, replaces what stood there also where it is a
    mapping, which Hydra merges. What a scenario says of a learner (``tuning``) gives way to the
    words.
    """
    own = OmegaConf.masked_copy(given, [str(key) for key in given if key != "hydra"])
    values: Any = OmegaConf.to_container(own, resolve=True)
    _check_whole(values, words, (given.get("hydra") or HydraConfig.get()).runtime.choices)
    known = known_settings(program)
    replaced = set[str]()
    for word in OverridesParser.create().parse_overrides([*words]):
        key = word.key_or_group
        value = word.value()
        setting = known.get(key)
        replaced |= (
            {key} if setting and not setting.is_section and isinstance(value, Mapping) else set()
        )
        if any(f"{key}.".startswith(f"{each}.") for each in replaced):
            set_at(values, key, value)
    tuned = values.pop("tuning", None) or {}
    for name, value in (tuned.get(values["learner"]["name"]) or {}).items() if tuned else ():
        if value is not None and f"learner.{name}" not in map(key_of, words):
            values["learner"][name] = value
    return values


def options_in(group: str, option: str = "*") -> Iterator[tuple[dict[str, Any], list[str]]]:
    """What the files of a group's options set, as nested settings, and what their defaults lists
    name.

    They lie in ``conf`` and in the folder of ``--config-dir``.
    """
    sources = HydraConfig.get().runtime.config_sources if HydraConfig.initialized() else ()
    for folder in (CONF, *(Path(source.path) for source in sources if source.schema == "file")):
        for file in sorted((folder / group).rglob(f"{option}.yaml")):
            text = file.read_text(encoding="utf-8")
            written = yaml.safe_load(text) or {}
            chosen = [
                name
                for each in written.pop("defaults", ())
                if isinstance(each, dict)
                for name in each
            ]
            yield written if "@package _global_" in text else {group: written}, chosen


def _check_whole(
    values: Mapping[str, Any], words: Sequence[str], choices: Mapping[str, Any]
) -> None:
    """Refuse a law that Hydra has merged from two files, such as that of a scenario over
    ``delay=burst``."""
    for key in (
        key for key in LAWS if not any(f"{key_of(word)}.".startswith(f"{key}.") for word in words)
    ):
        law = value_at(values, key)
        options = choices.items() if isinstance(law, Mapping) else ()
        files = [
            value_at(found, key)
            for each in options
            for found, _ in options_in(*each)
            if "/" not in each[0]
        ]
        written = [found for found in files if isinstance(found, Mapping) and "law" in found]
        checks.require(
            not written or law in written,
            key,
            law,
            "mixes laws of several files; write the one that you mean as a whole: "
            f"{key}={{law: ...}}",
        )


LAWS = ("delay.obs", "delay.act", "delay.rew", "links.delay")
"""Settings that are laws."""


def reason(error: BaseException, program: str = "train") -> str:
    """The deepest cause of an error on one line, with its key in front."""
    while not isinstance(error, InputError) and isinstance(error.__cause__, (*ERRORS, InputError)):
        error = error.__cause__
    text = str(error).partition("\nConfig search path")[0]
    key = getattr(error, "full_key", None)
    if isinstance(error, OSError) and error.filename and error.strerror:
        text = f"{error.filename}: {error.strerror}"
    elif isinstance(error, OmegaConfBaseException):
        text = text.partition("\n")[0]  # the others name types of OmegaConf
        if key and "not in struct" in text:
            text = no_such_key(str(key), program)
            key = None
    return one_line(f"{key}: {text}" if key else text)


@contextmanager
def one_line_errors(program: str = "train") -> Iterator[None]:
    """End a program with one line on stderr if input is wrong (code 2) or a run cannot go on
    (3)."""
    _register_own(sys.argv[1:])
    try:
        yield
    except EXPECTED as error:
        line = reason(error, program)
        cause = error.__cause__
        if os.environ.get("DAMIAN_TRACEBACK"):
            traceback.print_exception(error)
        elif cause is not None and not isinstance(cause, (*ERRORS, InputError)):
            line += " (DAMIAN_TRACEBACK=1 shows the traceback)"
        print(f"error: {line}", file=sys.stderr)
        sys.exit(RUN_ERROR if isinstance(error, RunError | OSError) else 2)
    except KeyboardInterrupt:
        end_interrupted()
    finally:
        if HydraConfig.initialized() and not OmegaConf.is_missing(
            HydraConfig.get().runtime, "output_dir"
        ):
            folder = Path(HydraConfig.get().runtime.output_dir)
            with suppress(
                OSError
            ):  # a refused run has nothing in the folder that Hydra has made for it
                if folder.resolve() != Path.cwd():
                    folder.rmdir()


def program(name: str) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """Decorator of a program's ``main``: Hydra composes its argument from ``conf/NAME.yaml`` and
    words."""

    def decorated(main: Callable[[DictConfig], None]) -> Callable[[], None]:
        @functools.wraps(main)
        def work(given: DictConfig) -> None:
            with one_line_errors(
                name
            ):  # here too: Hydra prints a line about an error that reaches it
                main(given)

        return one_line_errors(name)(hydra.main("../conf", name, version_base=None)(work))

    return decorated


def _sweep_name(sweep: Sequence[str]) -> str:
    """The name of a sweep's folder, the same for the same command: what is swept, and a hash of all
    words."""
    return f"{_run_name(sweep, sweep)}-{_hash(' '.join(sweep))}"


def _run_name(sweep: Sequence[str], words: Sequence[str]) -> str:
    """The name of a run's folder: the settings in which the runs of a sweep differ, or their
    hash."""
    parsed = OverridesParser.create().parse_overrides([*sweep])
    swept = {each.key_or_group for each in parsed if each.is_sweep_override()}
    text = "_".join(word.replace("=", "-") for word in words if key_of(word) in swept) or "run"
    name = re.sub(r"[^\w.,+-]+", "-", text).strip("-")
    return name if len(name) <= LONGEST_NAME else f"{name[:LONGEST_NAME]}-{_hash(text)}"


def _hash(text: str) -> str:
    return sha256(text.encode()).hexdigest()[:8]


LONGEST_NAME = 80
"""Letters of the name of a folder in a sweep before its hash."""
OmegaConf.register_new_resolver(
    "damian.typed", list, use_cache=True
)  # a run of a sweep finds those of all
OmegaConf.register_new_resolver("damian.sweep_name", _sweep_name)
OmegaConf.register_new_resolver("damian.run_name", _run_name)


def short(folder: Path) -> Path:
    """A folder as a person would write it: relative to the current one if it lies inside."""
    return folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder


def command() -> str:
    """The command line as it was typed, to be run again in a shell."""
    return f"{Path(sys.argv[0]).name} {shlex.join(sys.argv[1:])}"
