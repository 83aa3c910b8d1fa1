"""The command line of the programs: KEY=VALUE words, composed by Hydra, checked, and refused in one line.

Nothing here imports torch, so that help and a misspelt word are answered at once. A program starts with
``run(work)``, where ``work`` takes the checked settings and the run folder to fill.
"""

import os
import re
import shlex
import sys
import traceback
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import fields, is_dataclass
from functools import reduce
from importlib import import_module
from pathlib import Path
from typing import Any

os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra raises its errors, and ``one_line_errors`` prints them

import hydra
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigNode, ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, QuotedString
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException
from yaml import YAMLError

from damian.common.errors import RUN_ERROR, InputError, RunError
from damian.common.fields import Settings, is_whole, rules
from damian.common.registry import stored_settings
from damian.common.text_files import one_line, show
from damian.learners.config import LEARNERS
from damian.runs.interrupt import end_interrupted, number_of
from damian.runs.run_lock import locked

from .config import SEARCHES, TrainConfig
from .known import (
    CHOSEN,
    CONF,
    FILELESS,
    OWN,
    PLAIN,
    SCHEMAS,
    check_words,
    groups,
    is_known,
    key_of,
    known_settings,
    no_such_key,
    parsed,
    whole_laws,
)

Work = Callable[[Any, Path], None]
"""The work of a program: takes checked settings and the run folder to fill."""


# ------------------------------------------------------------------------------------------ schemas


def _pruned(settings: Any, kind: str | None = None) -> DictConfig:
    """The schema of settings without their constants, and without keys that only other kinds read."""
    node, found = OmegaConf.structured(settings), rules(type(settings))
    OmegaConf.set_struct(node, False)
    for name, rule in found.items():
        if rule.fixed or (kind and rule.kinds and kind not in rule.kinds):
            del node[name]
        elif is_dataclass(value := getattr(settings, name)) and name not in CHOSEN:
            node[name] = _pruned(value)
    return _untyped(node, type(settings))


def _untyped(node: DictConfig, kind: type) -> DictConfig:
    """A schema whose whole numbers have no type: ``Settings`` checks them and takes 1e6; Hydra would not."""
    OmegaConf.set_struct(node, False)
    for name in rules(kind):
        if name in node and is_whole(kind, name):
            value = node.pop(name)
            node[name] = list(value) if isinstance(value, ListConfig) else value
    OmegaConf.set_struct(node, None)
    return node


def _node(group: str, option: str) -> DictConfig:
    """What an option of ``PLAIN`` sets."""
    if group == "learner":
        return _pruned(LEARNERS.get(option, "learner")(name=option))
    if group in ("region", "motion", "links", "source", "battery"):
        node = _pruned(getattr(TrainConfig(), group), option)
        if group != "battery":
            node["motion" if group == "source" else "kind"] = option
        if option == "charging":
            node.enabled = True
        if option == "random":
            node.pool = 16  # a single random region would be learnt by heart
        return node
    if group == "logger":
        files = {"tensorboard": option != "csv", "csv": option != "tensorboard"}
        return OmegaConf.create({**files, **({"custom": [option]} if option == "wandb" else {})})
    return OmegaConf.create({"kind": option} if group == "actions" else {})


class _Options(dict[str, ConfigNode]):
    """The options of a group; ``package.module:Name`` is one of the user's own, read when it is chosen."""

    def __init__(self, group: str) -> None:
        super().__init__({f"{o}.yaml": self._option(group, o) for o in PLAIN[group]})
        self.group = group

    def __contains__(self, option: object) -> bool:
        return ":" in str(option) or super().__contains__(option)

    def __getitem__(self, option: str) -> ConfigNode:
        own = ":" in option
        return self._option(self.group, option.removesuffix(".yaml")) if own else super().__getitem__(option)

    @staticmethod
    def _option(group: str, option: str) -> ConfigNode:
        return ConfigNode(option, _node(group, option), group, None, "damian")


def _register() -> None:
    """Give Hydra the schemas and the options that need no file."""
    store = ConfigStore.instance()
    for name, kind in SCHEMAS.items():
        schema = _untyped(OmegaConf.structured(kind), kind) if name == "compare" else _pruned(kind())
        if name != "compare":
            OmegaConf.set_struct(schema, False)
            schema.tuning = {}
            for section in CHOSEN:
                del schema[section]  # the group of this name fills it in
        store.store(name=f"{name}_schema", node=schema)
    for name in FILELESS:
        store.store(name=name, node={"defaults": [f"{name}_schema", "defaults", "_self_"]})
    for learner, space in SEARCHES.items():
        store.store(group="search", name=learner, node=space)
    for group, options in PLAIN.items():
        store.repo[group] = _Options(group) if group in OWN else {}
        for option in () if group in OWN else options:
            package = "_global_" if group == "aware" else None
            store.store(group=group, name=option, node=_node(group, option), package=package)
    store.store(group="kind", name="polynomial", node=_pruned(TrainConfig().motion, "polynomial"))


_register()


# ------------------------------------------------------------------------------------------ composition

ERRORS = (HydraException, OmegaConfBaseException, YAMLError)
"""What Hydra raises for overrides and files that it cannot compose."""


def composed(program: str, overrides: Sequence[str], own_folder: str | None = None) -> DictConfig:
    """The configuration that Hydra composes from overrides, with its own section ``hydra``."""
    words = whole_laws(overrides)
    if own_folder:
        words.append(f"hydra.searchpath=['file://{Path(own_folder).resolve()}']")
    running = GlobalHydra.instance().hydra  # of a sweep, or of a Hydra application that calls this
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONF), version_base=None):
            found = compose(program, words, return_hydra_config=True)
        return _tuned(found, {key_of(word) for word in overrides})
    except (*ERRORS, ValueError) as error:  # such as a group that is set to a number
        raise InputError(reason(error, program, words)) from error
    finally:
        GlobalHydra.instance().hydra = running


def stored_words(words: Any, program: str, key: str, own_folder: str | None = None) -> list[str]:
    """The words of a stored command line that choose settings, to be composed again.

    They may come from anybody. Words that steer Hydra or this program are left out, and what is more than a
    plain value is refused: interpolations, sweeps, and options that are files of other folders. ``key`` is
    the setting that names where they are stored.
    """
    known, options, found = known_settings(program), groups(own_folder), []
    given = [*map(str, words)] if isinstance(words, list) else []
    try:
        parsed = OverridesParser.create().parse_overrides(given)
    except HydraException as error:
        raise InputError(f"{key}: its command line cannot be read: {reason(error)}") from None
    for each in parsed:
        name, sweeps = each.key_or_group, each.is_sweep_override()
        if re.split(r"\W", name)[0] in ("hydra", "trust", "checkpoint", "resume"):
            continue
        values = [] if sweeps else [*texts(each.value())]  # as Hydra reads them, without quotes and escapes
        plain = not (sweeps or each.package or any("${" in value for value in values))
        if name in options:
            own = [value for value in values if name in OWN and ":" in value and Path(value).name == value]
            plain = plain and {*values} <= {*options[name], *own}
        if not plain or not (name in options or is_known(name, known)):
            remedy = "repeat the --config-dir of the training, if it had one"
            raise InputError(f"{key}: {show(each.input_line)} is not an option or a plain value; {remedy}")
        found.append(str(each.input_line))
    return found


def texts(values: Any) -> Iterator[str]:
    """Every text in nested mappings and lists."""
    if isinstance(values, str):
        yield values
    elif isinstance(values, Mapping | Sequence):
        for each in values.values() if isinstance(values, Mapping) else values:
            yield from texts(each)


def _tuned(found: DictConfig, given: set[str]) -> DictConfig:
    """Apply what the scenario says of the chosen learner (``tuning``), unless the command line says else."""
    with open_dict(found):
        tuning = found.pop("tuning", {})
    for name, value in tuning.get(found.learner.name if "learner" in found else "", {}).items():
        if value is not None and f"learner.{name}" not in given:
            found.learner[name] = value
    return found


def without_hydra(found: DictConfig) -> DictConfig:
    copied = found.copy()
    with open_dict(copied):
        copied.pop("hydra", None)
    return copied


def checked(found: DictConfig, program: str = "train") -> Any:
    """A composed configuration as an instance of its dataclass, whose checks it passes."""
    plain = without_hydra(found)
    try:
        config: Any = OmegaConf.to_object(plain)
    except ERRORS as error:
        raise InputError(reason(error, program)) from error
    if unknown := list(_unknown(plain, config)):
        learner = [f"learner.{each.name}" for each in fields(config.learner)] if program != "compare" else []
        raise InputError(no_such_key(unknown[0], program, learner))
    return config


def _unknown(node: Any, config: Any, path: str = "") -> Iterator[str]:
    """Keys that no field of the settings takes; such as those that Hydra's ``+a.b=1`` adds."""
    values = {each.name: getattr(config, each.name) for each in fields(config)}
    for key in node:
        if key not in values:
            yield f"{path}{key}"
        elif is_dataclass(values[key]):
            yield from _unknown(node[key], values[key], f"{path}{key}.")


def settings(*overrides: str, program: str = "train", own_folder: str | None = None) -> Any:
    """The checked settings of a program with these overrides, for Python programs too."""
    check_words(program, overrides, own_folder)
    return checked(composed(program, overrides, own_folder), program)


def check(program: str, given: Namespace) -> str:
    """The settings of a command line as YAML, checked as far as that goes without torch."""
    if given.multirun or {"checkpoint", "resume"} & set(map(key_of, given.overrides)):
        return ""
    found = composed(program, given.overrides, given.config_dir)
    checked(found, program)
    return OmegaConf.to_yaml(without_hydra(found))


# ------------------------------------------------------------------------------------------ errors


def reason(error: BaseException, program: str = "train", words: Sequence[str] = ()) -> str:
    """The deepest cause of an error on one line, with its key in front."""
    while not isinstance(error, InputError) and isinstance(error.__cause__, (*ERRORS, InputError)):
        error = error.__cause__
    key = getattr(error, "full_key", None)
    if isinstance(error, (ConfigKeyError, ConfigAttributeError)) and key:
        section, node = key.rpartition(".")[0], getattr(error, "parent_node", None) or {}
        chosen = {key_of(word): word.partition("=")[2] for word in words}
        kind = next((node[name] for name in ("kind", "name", "motion") if name in node), None)
        beside = [f"{section}.{name}" for name in node]
        return no_such_key(str(key), program, beside, chosen.get(section, kind))
    text = str(error)
    if isinstance(error, OSError) and error.filename and error.strerror:
        text = f"{error.filename}: {error.strerror}"
    if isinstance(error, OmegaConfBaseException) and not text.partition("\n")[0].endswith(":"):
        text = text.partition("\n")[0]  # the others name types of OmegaConf
    return one_line(f"{key}: {text}" if key else text)


@contextmanager
def one_line_errors() -> Iterator[None]:
    """End the program with one line on stderr if input is wrong (code 2) or a run cannot go on (3)."""
    try:
        yield
    except (InputError, RunError, OSError, *ERRORS) as error:
        line, cause = reason(error), error.__cause__
        if os.environ.get("DAMIAN_TRACEBACK"):
            traceback.print_exception(error)
        elif cause is not None and not isinstance(cause, (*ERRORS, InputError)):
            line += " (DAMIAN_TRACEBACK=1 shows the traceback)"
        print(f"error: {line}", file=sys.stderr)
        sys.exit(RUN_ERROR if isinstance(error, RunError | OSError) else 2)
    except KeyboardInterrupt as error:
        end_interrupted(number_of(error))


# ------------------------------------------------------------------------------------------ running


def run(work: Work, program: str = "train", again: bool = False) -> None:
    """Run a program with the words of the command line; with ``-m`` once for each combination of values.

    With ``again`` the same command in the same folder goes on with what is there, as a comparison does.
    """
    with one_line_errors():
        given = parsed(sys.argv[1:])
        check_words(program, given.overrides, given.config_dir)
        if not given.multirun:
            _start(work, program, given.overrides, given.config_dir, again=again)
            return
        if again:
            raise InputError("-m: not with programs that carry out many runs anyway")

        first = [f"--config-dir={given.config_dir}"] if given.config_dir else []
        if any(key_of(word) == "checkpoint" and "," in word for word in given.overrides):
            first.append("hydra.job.config.override_dirname.exclude_keys=[]")  # else runs share a folder
        sweep = Path(_first_run(program, given).hydra.sweep.dir).absolute()
        made = [each for each in (sweep, *sweep.parents) if not each.exists()]
        words = [*given.overrides, f"hydra.sweep.dir='{sweep}'"]
        sys.argv[1:] = ["-m", *first, *words]  # Hydra wants options first

        @hydra.main(version_base=None, config_path=str(CONF), config_name=program)
        def job(_: DictConfig) -> None:
            output, own = Path(HydraConfig.get().runtime.output_dir), list(HydraConfig.get().overrides.task)
            try:
                with one_line_errors():
                    _start(work, program, own, given.config_dir, output)
            finally:
                with suppress(OSError):  # Hydra has made it; it is not empty unless the run was refused
                    output.rmdir()

        try:
            job()
        finally:
            with suppress(OSError):
                if [*sweep.iterdir()] == [sweep / "multirun.yaml"]:  # every run was refused
                    (sweep / "multirun.yaml").unlink()
                    for each in made:
                        each.rmdir()


def _first_run(program: str, given: Namespace) -> DictConfig:
    """The configuration of the first run of a sweep; what is wrong in any is refused before a folder is made.

    The first is checked, and each whole number of the others by itself; Hydra checks the rest of the types.
    """
    overrides = OverridesParser.create().parse_overrides(given.overrides)
    swept = [each for each in overrides if each.is_discrete_sweep() and not isinstance(each.value(), Glob)]
    words = [
        f"{each.get_key_element()}={next(each.sweep_string_iterator())}"
        if each in swept
        else str(each.input_line)
        for each in overrides
    ]
    found = composed(program, words, given.config_dir)
    if {"checkpoint", "resume"} & set(map(key_of, words)):
        return found
    config = checked(found, program)
    for each in swept:
        *sections, name = each.get_key_element().split(".")
        section = reduce(lambda at, part: getattr(at, part, None), sections, config)
        if isinstance(section, Settings) and name in rules(type(section)) and is_whole(type(section), name):
            for value in each.sweep_iterator():
                section.checked(name, value.text if isinstance(value, QuotedString) else value)
    return found


class SweepReport(Callback):
    """Reports on a sweep when all of its runs have ended, whichever processes or machines they were in."""

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        import_module(".results", __package__).show_sweep(shown(Path(config.hydra.sweep.dir)))  # needs torch


def _start(
    work: Work,
    program: str,
    words: list[str],
    own_folder: str | None,
    job_folder: Path | None = None,
    again: bool = False,
) -> None:
    """Run a program once, for a sweep in ``job_folder``; a run that is refused leaves no folder."""
    given = composed(program, words, own_folder)
    with only_named_code(given):
        asked = shown(job_folder or Path(given.hydra.run.dir))
        runs = import_module(".shared.runs", __package__)  # it imports torch
        config, folder = runs.prepared(program, given, words, own_folder, asked, again)
        _perform(work, runs, config, folder, again)


def only_named_code(given: DictConfig) -> AbstractContextManager[None]:
    """While a run takes settings from a file, only code that the present command line names is imported."""
    if not any(key in given and given[key] is not None for key in ("checkpoint", "resume", "journal")):
        return nullcontext()
    named = texts(OmegaConf.to_container(without_hydra(given), resolve=True))
    return stored_settings([*named], bool(given.trust))


def _perform(work: Work, runs: Any, config: Any, folder: Path, again: bool) -> None:
    """Do the work of a run in its folder, which is locked, and removed if nothing was written."""
    key = "resume" if getattr(config, "resume", None) else "hydra.run.dir"
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{key}: {folder} cannot be a run folder: {error.strerror}") from None
    only_reads = getattr(config, "report_only", False)  # a comparison may be reported on while it runs
    try:
        with nullcontext() if only_reads else locked(folder, key):
            if again:
                work(config, folder)
            else:
                runs.perform(config, folder, work)
    finally:
        with suppress(OSError):  # it is not empty
            for each in made:
                each.rmdir()


def shown(folder: Path) -> Path:
    """A folder as a person would write it: relative to the current one if it lies inside."""
    return folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder


def command() -> str:
    """The command line as it was typed, to be run again in a shell."""
    return f"{Path(sys.argv[0]).name} {shlex.join(sys.argv[1:])}"
