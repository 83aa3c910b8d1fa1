"""Run a recipe: from the command line to a checked configuration, with errors of one line."""

import functools
import os
import shlex
import sys
import traceback
from collections.abc import Callable, Collection, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn, cast

os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra raises its errors, and ``launch`` prints them

import torch
from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torchrl.checkpoint import Checkpoint

from damian.common.errors import InputError
from damian.evaluation.run_folder import CHECKPOINT, CONFIG
from damian.evaluation.run_record import RECORD, new_record, timed, write_record
from damian.learners.base import LEARNERS

from .command_line import own_folder, prepared
from .composition_errors import COMPOSITION_ERRORS, foreign_cause, one_line
from .inheritance import changes, check_policy_fits, inherited, key_of
from .known_settings import RECIPES, SCHEMAS
from .misspelt import no_such_key
from .settings import TrainConfig

Program = Callable[[TrainConfig, Path], None]
"""The work of a recipe: takes a checked configuration and the run folder to fill."""
SWEEP = "multirun.yaml"
"""File that Hydra writes into the folder of a sweep."""


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
        _drop_empty(folder)
        folder = shown(Path(composed.resume))
        config: TrainConfig = checked(_resumed(folder, composed, overrides))
        _say_if_trained(config, folder)
        return config, folder
    if (folder / CONFIG).exists():
        remedy = f"choose another folder, or continue the run with resume={folder}"
        raise InputError(f"hydra.run.dir: {folder} holds a run already; {remedy}")
    stored = None if composed.checkpoint is None else stored_run(Path(composed.checkpoint))
    if stored:
        overrides = inherited(stored, overrides)
        composed = composed_with(str(hydra.job.config_name), overrides)
    config = checked(composed)
    config.overrides = overrides
    if stored:
        check_policy_fits(config, stored)
        if changed := changes(config, stored):
            print(f"changed since the training: {changed}")
    return config, folder


def stored_run(folder: Path) -> TrainConfig | None:
    """The checked configuration of the run in a folder; None if there is no run.

    Raises:
        InputError: the run's configuration cannot be read.
    """
    _refuse_sweep(folder, "checkpoint")
    if not (folder / CONFIG).is_file():
        return None  # loading the checkpoint will report what is missing
    return cast(TrainConfig, OmegaConf.to_object(stored_config(folder, "checkpoint")))


def composed_with(config_name: str, overrides: Sequence[str]) -> DictConfig:
    """The configuration that Hydra composes from overrides.

    Raises:
        InputError: the overrides cannot be composed.
    """
    try:
        return compose(config_name, list(overrides))
    except COMPOSITION_ERRORS as error:
        raise InputError(one_line(error)) from error


def perform(config: TrainConfig, folder: Path, program: Program) -> None:
    """Run a program with the threads and the seed of its configuration.

    A run that is refused before it has learnt or measured anything leaves no folder.
    """
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    was_empty = not folder.is_dir() or not any(folder.iterdir())
    try:
        with timed(folder):
            program(config, folder)
    except (InputError, OmegaConfBaseException):
        if was_empty:
            _drop_unused(folder)
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


def save_config(config: TrainConfig, folder: Path) -> None:
    """Write the resolved configuration into the run folder, and the record of versions and machine."""
    folder.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(OmegaConf.structured(config), folder / CONFIG)
    is_gpu = config.device.startswith("cuda")
    device = torch.cuda.get_device_name(config.device) if is_gpu else config.device
    write_record(folder, new_record(command(typed_words()), device, config.threads, own_folder()))


def stored_config(folder: Path, key: str) -> DictConfig:
    """The configuration of the run in a folder; keys that it lacks have their defaults.

    Args:
        folder: the run folder.
        key: the setting that names the folder, for the error message.

    Raises:
        InputError: it cannot be read, or damian 0.1 has written it.
    """
    file = folder / CONFIG
    try:
        saved = cast(DictConfig, OmegaConf.load(file))
        if "algo" in saved:
            raise InputError("damian 0.1 wrote it, and settings have other names since: train again")
        learner = LEARNERS.get(saved.learner.name, "learner")(name=saved.learner.name)
        schema = OmegaConf.structured(TrainConfig(learner=learner))
        return cast(DictConfig, OmegaConf.merge(schema, saved))
    except Exception as error:  # a damaged file can raise anything
        raise InputError(f"{key}: {file}: {one_line(error)}") from None


def load(checkpoint: Checkpoint, folder: Path, key: str, components: Collection[str] | None = None) -> None:
    """Restore a checkpoint from a run folder.

    Args:
        checkpoint: its components are restored in place.
        folder: the run folder.
        key: the setting that names the folder, for the error message.
        components: names of the components to restore; all if not given.

    Raises:
        InputError: the checkpoint is missing or incomplete, or belongs to another configuration.
    """
    try:
        checkpoint.load(folder / CHECKPOINT, components=components)
    except Exception as error:  # a damaged file can raise anything
        cause = None if isinstance(error, OSError) else error
        raise InputError(f"{key}: {folder / CHECKPOINT}: {one_line(error)}") from cause


def _resumed(folder: Path, composed: DictConfig, overrides: Sequence[str]) -> DictConfig:
    allowed = ("resume", "frames", "episodes")
    refused = [override for override in overrides if key_of(override) not in allowed]
    if refused:
        raise InputError(
            f"{refused[0]}: a resumed run keeps its configuration; only frames= and episodes= may change"
        )
    _refuse_sweep(folder, "resume")
    for needed in (CONFIG, CHECKPOINT):
        if not (folder / needed).exists():
            raise InputError(f"resume: {folder} holds no {needed}, so there is no run to resume")
    changed = {key: composed[key] for key in map(key_of, overrides)}
    return cast(DictConfig, OmegaConf.merge(stored_config(folder, "resume"), changed))


def _refuse_sweep(folder: Path, key: str) -> None:
    if (folder / SWEEP).is_file() and not (folder / CONFIG).exists():
        raise InputError(f"{key}: {folder} is a sweep: give one of the folders in it")


class _Stored(dict[str, Any]):
    """A component of a checkpoint as it was stored."""

    state_dict = dict.copy
    load_state_dict = dict.update


def _say_if_trained(config: TrainConfig, folder: Path) -> None:
    """Say that a resumed run has nothing left to train, if that is so."""
    progress, episodes = _Stored(), _Stored()
    load(Checkpoint(progress=progress, episodes=episodes), folder, "resume", ["progress", "episodes"])
    done = {"frames": progress["frames"], "episodes": episodes["finished"]}
    for key, number in done.items():
        limit = getattr(config, key)
        if limit is not None and number >= limit:
            print(f"{key}: {limit} are asked for, and the run has {number} already: nothing is left to train")
            return


_composed: list[bool] = []
"""Not empty once Hydra has composed a configuration: a later error of Hydra's is not a wrong command line."""


_typed: list[str] = []
"""The command line as it was typed; empty in a worker process of a comparison."""


def typed_words() -> list[str]:
    """The words of the command line as they were typed, without the name of the program."""
    return (_typed or sys.argv)[1:]


def command(words: Sequence[str]) -> str:
    """The command that runs this program with words, to be typed in a shell."""
    program = Path(sys.argv[0])
    if program.suffix == ".py":
        is_ours = (RECIPES / program.name).exists()
        return shlex.join([*(["damian", program.stem] if is_ours else ["python", str(program)]), *words])
    return f"{program.name} {shlex.join(words)}".strip()


def reported(main: Callable[[DictConfig], None]) -> Callable[[DictConfig], None]:
    """Turn wrong input into one line on stderr and exit code 2, and remove the empty run folder."""

    @functools.wraps(main)
    def checked_main(composed: DictConfig) -> None:
        _composed.append(True)
        try:
            main(composed)
        except (InputError, OmegaConfBaseException) as error:
            _drop_empty(Path(HydraConfig.get().runtime.output_dir))
            _give_up(error, str(HydraConfig.get().job.config_name))

    return checked_main


def launch(main: Callable[[], Any], program: str = "train") -> None:
    """Run a Hydra application; overrides that Hydra refuses end with one line on stderr and exit code 2.

    Args:
        main: the application.
        program: name of its file in conf/.
    """
    _typed[:] = sys.argv
    _composed.clear()
    try:
        sys.argv[1:] = prepared(sys.argv[1:])
        main()
    except COMPOSITION_ERRORS as error:
        if _composed:
            raise  # this is a bug, and its traceback is needed
        if folder := _sweep_folder(error):
            _drop_sweep(folder)
        _give_up(error, program)


def _give_up(error: Exception, program: str) -> NoReturn:
    line, cause = one_line(error, program if program in SCHEMAS else "train"), foreign_cause(error)
    if cause and os.environ.get("DAMIAN_TRACEBACK"):
        traceback.print_exception(cause)
    elif cause:
        line += " (DAMIAN_TRACEBACK=1 shows the traceback)"
    print(f"error: {line}", file=sys.stderr)
    sys.exit(2)


def _sweep_folder(error: Exception) -> Path | None:
    """The folder that Hydra made for a sweep that it then refused; only Hydra's frame knows its name."""
    frames = (frame for frame, _ in traceback.walk_tb(error.__traceback__))
    return next((frame.f_locals["sweep_dir"] for frame in frames if "sweep_dir" in frame.f_locals), None)


def _drop_unused(folder: Path) -> None:
    """Remove a run folder with nothing in it but what is written before the first step."""
    files = [*folder.iterdir()] if folder.is_dir() else []
    if all(path.name in (CONFIG, RECORD) or path.name.startswith("events.out.tfevents") for path in files):
        for path in files:
            path.unlink()
        _drop_empty(folder)


def _drop_empty(folder: Path) -> None:
    """Remove an empty run folder, and the folders that Hydra made around it."""
    if not folder.is_dir() or any(folder.iterdir()):
        return
    folder.rmdir()
    _drop_sweep(folder.parent)
    if folder.parent.is_dir() and folder.parent.resolve() != Path.cwd() and not any(folder.parent.iterdir()):
        folder.parent.rmdir()


def _drop_sweep(folder: Path) -> None:
    """Remove the folder of a sweep of which no run is left."""
    if folder.is_dir() and [path.name for path in folder.iterdir()] == [SWEEP]:
        (folder / SWEEP).unlink()
        _drop_empty(folder)
