"""Run a recipe: from the command line to a checked configuration, with errors of one line."""

import functools
import os
import random
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn

os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra raises its errors, and ``launch`` prints them

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from damian.common import checks
from damian.common.atomic_files import remove_unfinished, writing
from damian.common.errors import RUN_ERROR, InputError, RunError
from damian.runs.interrupt import exit_code
from damian.runs.run_folder import CHECKPOINT, CONFIG
from damian.runs.run_lock import is_empty, locked
from damian.runs.run_record import timed

from .command_line import parsed, prepared, remember_words
from .composition_errors import COMPOSITION_ERRORS, foreign_cause, one_line
from .inheritance import changes, check_policy_fits, inherited, note_what_a_history_holds, own_defaults
from .known_settings import CONF, SCHEMAS
from .leftovers import drop_empty, drop_sweep, drop_unused, remember_folders, sweep_folder
from .misspelt import no_such_key
from .settings import TrainConfig
from .stored_runs import resumed_config, say_if_trained, stored_run

Program = Callable[[TrainConfig, Path], None]
"""The work of a recipe: takes a checked configuration and the run folder to fill."""
ALREADY_MANY = {
    "compare": "a comparison runs all of its arms and seeds",
    "tune": "a search runs all of its trials",
}
"""Programs that carry out many runs by themselves."""


def prepare(composed: DictConfig) -> tuple[TrainConfig, Path]:
    """The checked configuration of a recipe, and its run folder.

    A resumed run continues in its own folder with its own configuration; only ``frames`` and ``episodes``
    may change. The overrides of the run that ``checkpoint`` names apply too, unless others are given.

    Args:
        composed: the configuration that Hydra composed from the command line.

    Raises:
        InputError: a value is impossible, a key is unknown, or there is no run to resume.
    """
    hydra = HydraConfig.get()
    folder, overrides = shown(Path(hydra.runtime.output_dir)), list(hydra.overrides.task)
    if composed.resume is not None:
        if hydra.mode == RunMode.MULTIRUN:
            raise InputError("resume: only one run can be resumed at a time; leave out -m")
        drop_empty(folder)
        folder = shown(Path(composed.resume))
        config: TrainConfig = checked(resumed_config(folder, composed, overrides))
        say_if_trained(config, folder)
        return config, folder
    if (folder / CONFIG).exists():
        remedy = f"choose another folder, or continue the run with resume={folder}"
        raise InputError(f"hydra.run.dir: {folder} holds a run already; {remedy}")
    stored = None if composed.checkpoint is None else stored_run(Path(composed.checkpoint))
    if stored:
        overrides = inherited(stored, overrides, own_defaults(OmegaConf.get_type(composed) or TrainConfig))
        composed = composed_with(str(hydra.job.config_name), overrides)
    config = checked(composed)
    config.overrides = overrides
    if stored:
        check_policy_fits(config, stored)
        if changed := changes(config, stored):
            print(f"changed since the training: {changed}")
        note_what_a_history_holds(config, stored)
    return config, folder


def composed_with(config_name: str, overrides: Sequence[str]) -> DictConfig:
    """The configuration that Hydra composes from overrides.

    Raises:
        InputError: the overrides cannot be composed.
    """
    try:
        return compose(config_name, list(overrides))
    except COMPOSITION_ERRORS as error:
        raise InputError(one_line(error)) from error


def composed_config(*overrides: str) -> TrainConfig:
    """The checked settings of ``damian train`` with these overrides, in a program that need not be Hydra's.

    Raises:
        InputError: an override is misspelt, or its value is impossible.
    """
    for override in overrides:
        should = "is not a text such as agents=5: write one argument for each override"
        checks.require(isinstance(override, str), "override", override, should)
    running = GlobalHydra.instance().hydra  # of a Hydra application that calls this
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(CONF, version_base=None):
            return checked(composed_with("train", overrides))
    except OmegaConfBaseException as error:
        raise InputError(one_line(error)) from error
    finally:
        GlobalHydra.instance().hydra = running


def seed_generators(seed: int) -> None:
    """Seed the global random generators of torch, NumPy and Python; components of one's own may use each."""
    for set_seed in (torch.manual_seed, np.random.seed, random.seed):
        set_seed(seed)


def perform(config: TrainConfig, folder: Path, program: Program) -> None:
    """Run a program in one thread with the seed of its configuration.

    A run that is refused before it has learnt or measured anything leaves no folder.
    """
    torch.set_num_threads(1)
    seed_generators(config.seed)
    was_empty = is_empty(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    remove_unfinished(folder)
    try:
        with timed(folder):
            program(config, folder)
    except (InputError, OmegaConfBaseException):
        if was_empty:
            drop_unused(folder)
        raise
    print(f"results: {folder}")


def shown(folder: Path) -> Path:
    """A folder as a person would write it: relative to the current one if it lies inside."""
    return folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder


def checked(composed: DictConfig, program: str = "train") -> Any:
    """A composed configuration as an instance of its schema: a ``TrainConfig``, or another one.

    Args:
        composed: the configuration that Hydra composed.
        program: a key of ``SCHEMAS``, whose keys are suggested for an unknown one.

    Raises:
        InputError: a value is impossible, or a key is unknown.
    """
    config = OmegaConf.to_object(composed)
    unknown = unknown_keys(composed, config)
    if unknown:
        learner = getattr(config, "learner", None)
        beside = [f"learner.{field.name}" for field in fields(learner)] if learner else []
        raise InputError(no_such_key(unknown[0], program, beside=beside))
    return config


def unknown_keys(composed: Any, config: Any, path: str = "") -> list[str]:
    """Keys that no field of the config takes; Hydra's ``+a.b=1`` adds keys that the schema does not have."""
    values = {f.name: getattr(config, f.name) for f in fields(config)}
    unknown = [f"{path}{key}" for key in composed if key not in values]
    for key, value in values.items():
        if hasattr(value, "__dataclass_fields__") and key in composed:
            unknown += unknown_keys(composed[key], value, f"{path}{key}.")
    return unknown


_composed: list[bool] = []
"""Not empty once Hydra has composed a configuration: a later error of Hydra's is not a wrong command line."""


def reported(main: Callable[[DictConfig], None]) -> Callable[[DictConfig], None]:
    """Lock the run folder, turn errors into one line on stderr, and remove a folder that stays empty.

    The exit code is 2 for wrong input, ``RUN_ERROR`` if the run could not go on, 130 after Ctrl-C.
    """

    @functools.wraps(main)
    def checked_main(composed: DictConfig) -> None:
        _composed.append(True)
        own_folder = shown(Path(HydraConfig.get().runtime.output_dir))
        resumed = composed.get("resume") if HydraConfig.get().mode != RunMode.MULTIRUN else None
        folder, key = (Path(resumed), "resume") if resumed else (own_folder, "hydra.run.dir")
        # A comparison may be reported on while it runs.
        lock = nullcontext() if composed.get("report_only") else locked(folder, key)
        try:
            with lock:
                main(composed)
        except BaseException as error:
            if is_interrupt(error):
                drop_empty(own_folder)
                sys.exit(interrupted(folder, signal.SIGINT))
            if not isinstance(error, (InputError, OmegaConfBaseException, RunError, OSError)):
                raise
            drop_empty(own_folder)
            if isinstance(error, (RunError, OSError)):
                _stop(error)
            _give_up(error, str(HydraConfig.get().job.config_name))

    return checked_main


def is_interrupt(error: BaseException | None) -> bool:
    """Was the error raised by Ctrl-C, or while a library cleaned up after it?"""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def interrupted(folder: Path, number: int) -> int:
    """Say that a signal has stopped a run, and how to continue it; returns the exit code."""
    remedy = f"; continue with resume={folder}" if (folder / CHECKPOINT).exists() else ""
    print(f"interrupted{remedy}", file=sys.stderr)
    return exit_code(number)


def launch(main: Callable[[], Any], program: str = "train") -> None:
    """Run a Hydra application; overrides that Hydra refuses end with one line on stderr and exit code 2.

    Args:
        main: the application.
        program: name of its file in conf/.
    """
    remember_words()
    _composed.clear()
    try:
        sys.argv[1:] = prepared(sys.argv[1:])
        remember_folders(sys.argv[1:])
        if program in ALREADY_MANY and parsed(sys.argv[1:]).multirun:
            raise InputError(f"-m: {ALREADY_MANY[program]} anyway; leave it out")
        main()
    except (*COMPOSITION_ERRORS, KeyboardInterrupt) as error:
        if isinstance(error, KeyboardInterrupt) or is_interrupt(error):  # before a run began
            print("interrupted", file=sys.stderr)
            sys.exit(exit_code(signal.SIGINT))
        if _composed:
            raise  # this is a bug, and its traceback is needed
        if folder := sweep_folder(error):
            drop_sweep(folder)
        _give_up(error, program)


def _give_up(error: Exception, program: str) -> NoReturn:
    line, cause = one_line(error, program if program in SCHEMAS else "train"), foreign_cause(error)
    if cause and os.environ.get("DAMIAN_TRACEBACK"):
        traceback.print_exception(cause)
    elif cause:
        line += " (DAMIAN_TRACEBACK=1 shows the traceback)"
    print(f"error: {line}", file=sys.stderr)
    sys.exit(2)


def _stop(error: Exception) -> NoReturn:
    """End a run that cannot go on, with one line."""
    if os.environ.get("DAMIAN_TRACEBACK"):
        traceback.print_exception(error)
    print(f"error: {one_line(error)}", file=sys.stderr)
    sys.exit(RUN_ERROR)
