"""Runs in their folders: writing the configuration of one, and reading that of an earlier one."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import torch
from omegaconf import DictConfig, OmegaConf

from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError
from damian.learners.base import LEARNERS
from damian.runs.checkpoint import digest
from damian.runs.run_folder import CONFIG
from damian.runs.run_lock import is_folder
from damian.runs.run_record import POLICY, check_version, new_record, write_record
from damian.runs.training_state import checkpoint_file, stored_progress

from .command_line import own_folder, typed_command
from .composition_errors import one_line
from .inheritance import key_of
from .leftovers import SWEEP
from .settings import TrainConfig

_ALWAYS_STORED = ("agents", "learner", "region", "seed", "worlds")
"""Sections and settings that every ``config.yaml`` has; others may be newer than it."""


def save_config(config: TrainConfig, folder: Path) -> None:
    """Write the record of versions and machine into the run folder, then the resolved configuration."""
    is_gpu = config.device.startswith("cuda")
    device = torch.cuda.get_device_name(config.device) if is_gpu else config.device
    record = new_record(typed_command(), device, config.learning_threads, own_folder())
    if config.checkpoint and not config.resume:  # a resumed run no longer needs that policy
        record[POLICY] = digest(checkpoint_file(Path(config.checkpoint), "checkpoint"))
    write_record(folder, record)
    write_atomically(folder / CONFIG, OmegaConf.to_yaml(OmegaConf.structured(config)))


def stored_run(written: Path) -> TrainConfig:
    """The checked configuration of a run.

    Args:
        written: the run folder, or a checkpoint file in it.

    Raises:
        InputError: there is no run, or its configuration cannot be read.
    """
    folder = run_folder(written)
    check_run(folder, "checkpoint")
    return cast(TrainConfig, OmegaConf.to_object(stored_config(folder, "checkpoint")))


def run_folder(written: Path) -> Path:
    """The run folder that a folder, or a checkpoint file in it, stands for."""
    return written.parent if os.path.isfile(written) else written


def check_run(folder: Path, key: str) -> None:
    """Check that a folder holds a run.

    Raises:
        InputError: it does not, such as the folder of a sweep.
    """
    if not is_folder(folder):
        name = str(folder) if len(str(folder)) <= 200 else f"{str(folder)[:200]}..."
        raise InputError(f"{key}: {name} holds no {CONFIG}: there is no such folder")
    if (folder / CONFIG).is_file():
        return
    if (folder / SWEEP).is_file():
        raise InputError(f"{key}: {folder} is a sweep: give one of the folders in it")
    raise InputError(f"{key}: {folder} holds no {CONFIG}, so there is no run")


def stored_config(folder: Path, key: str) -> DictConfig:
    """The configuration of the run in a folder; keys that it lacks have their defaults.

    Args:
        folder: the run folder.
        key: the setting that names the folder, for the error message.

    Raises:
        InputError: it cannot be read, or another minor version of damian has written it.
    """
    check_version(folder, key)
    file = folder / CONFIG
    try:
        saved = cast(DictConfig, OmegaConf.load(file))
        if "policy" in saved:
            flown = f"the one of {saved.checkpoint}" if saved.checkpoint else "a script"
            raise InputError(f"it holds no policy: {flown} was flown there")
        missing = [name for name in _ALWAYS_STORED if name not in saved]
        if missing:
            raise InputError(f"it has no {missing[0]}, so it is not the whole configuration of a run")
        learner = LEARNERS.get(saved.learner.name, "learner")(name=saved.learner.name)
        schema = OmegaConf.structured(TrainConfig(learner=learner))
        return cast(DictConfig, OmegaConf.merge(schema, saved))
    except Exception as error:  # a damaged file can raise anything
        raise InputError(f"{key}: {file}: {one_line(error)}") from None


def resumed_config(folder: Path, composed: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """The configuration of a run to resume; only ``frames`` and ``episodes`` may change.

    Raises:
        InputError: there is no run to resume, or something else is to change.
    """
    allowed = ("resume", "frames", "episodes")
    refused = [override for override in overrides if key_of(override) not in allowed]
    if refused:
        raise InputError(
            f"{refused[0]}: a resumed run keeps its configuration; only frames= and episodes= may change"
        )
    check_run(folder, "resume")
    checkpoint_file(folder, "resume")
    changed = {key: composed[key] for key in map(key_of, overrides)}
    return cast(DictConfig, OmegaConf.merge(stored_config(folder, "resume"), changed))


def say_if_trained(config: TrainConfig, folder: Path) -> None:
    """Say that a resumed run has nothing left to train, if that is so."""
    stored = stored_progress(folder)
    done = {"frames": stored["progress"]["frames"], "episodes": stored["episodes"]["finished"]}
    for key, number in done.items():
        limit = getattr(config, key)
        if limit is not None and number >= limit:
            print(f"{key}: {limit} are asked for, and the run has {number} already: nothing is left to train")
            return
