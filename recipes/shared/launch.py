"""From a command line to a checked configuration, with errors that are one line."""

import functools
import os
import sys
from collections.abc import Callable, Collection, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn, cast

os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra raises; ``launch`` prints
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import torch
from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torchrl.checkpoint import Checkpoint

from damian.common.errors import InputError
from damian.evaluation.run_folder import CHECKPOINT, CONFIG
from shared.composition_errors import COMPOSITION_ERRORS, no_such_key, one_line, set_schema
from shared.settings import LEARNERS, TrainConfig

Program = Callable[[TrainConfig, Path], None]
"""Fills a run folder, as a configuration says."""


def prepare(composed: DictConfig) -> tuple[TrainConfig, Path]:
    """The checked configuration of what Hydra composed, and the run folder.

    A resumed run goes on in its own folder with its own configuration; only how long it lasts may change. The
    overrides of a run named by ``checkpoint`` hold too, where the command line gives no others.

    Raises:
        InputError: a value is impossible, a key is unknown, or there is nothing to resume.
    """
    hydra = HydraConfig.get()
    folder, overrides = Path(hydra.runtime.output_dir), list(hydra.overrides.task)
    if composed.resume is not None:
        if hydra.mode == RunMode.MULTIRUN:
            raise InputError("resume: one run goes on at a time; leave out -m")
        _drop_empty(folder)
        folder = Path(composed.resume)
        return checked(_resumed(folder, overrides)), folder
    if (folder / CONFIG).exists():
        raise InputError(f"hydra.run.dir: {folder} holds a run already; resume={folder} goes on with it")
    if composed.checkpoint is not None:
        overrides = inherited(Path(composed.checkpoint), overrides)
        composed = composed_with(str(hydra.job.config_name), overrides)
    config = checked(composed)
    config.overrides = overrides
    return config, folder


def composed_with(config_name: str, overrides: Sequence[str]) -> DictConfig:
    """What Hydra composes from overrides.

    Raises:
        InputError: they cannot be composed.
    """
    try:
        return compose(config_name, list(overrides))
    except COMPOSITION_ERRORS as error:
        raise InputError(one_line(error)) from error


def inherited(folder: Path, overrides: Sequence[str]) -> list[str]:
    """The overrides of the run in a folder, where these give no others, and these.

    Raises:
        InputError: the run's configuration cannot be read.
    """
    if not (folder / CONFIG).is_file():
        return list(overrides)  # loading the checkpoint will say what is missing
    given = [_key(word) for word in overrides]
    saved = cast(list[str], OmegaConf.to_container(stored_config(folder, "checkpoint"))["overrides"])  # type: ignore
    return [word for word in saved if not any(_sets(key, _key(word)) for key in given)] + list(overrides)


def _key(override: str) -> str:
    return override.lstrip("+~").partition("=")[0]


def _sets(given: str, key: str) -> bool:
    """Does an override of the one, perhaps a group, also decide about the other?"""
    return key == given or key.startswith(f"{given}.")


def perform(config: TrainConfig, folder: Path, program: Program) -> None:
    """Run a program with its threads and its seed."""
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    program(config, folder)


def checked(composed: DictConfig) -> Any:
    """A composed configuration as an instance of its schema: a ``TrainConfig``, or another one.

    Raises:
        InputError: a value is impossible, or a key is unknown.
    """
    config = OmegaConf.to_object(composed)
    unknown = unknown_keys(composed, config)
    if unknown:
        raise InputError(no_such_key(unknown[0]))
    return config


def unknown_keys(composed: Any, config: Any, path: str = "") -> list[str]:
    """Keys that no field of the config takes: Hydra's ``+a.b=1`` adds them past a schema."""
    known = {f.name: getattr(config, f.name) for f in fields(config)}
    unknown = [f"{path}{key}" for key in composed if key not in known]
    for key, value in known.items():
        if hasattr(value, "__dataclass_fields__") and key in composed:
            unknown += unknown_keys(composed[key], value, f"{path}{key}.")
    return unknown


def save_config(config: TrainConfig, folder: Path) -> None:
    """Write the resolved configuration into the run folder."""
    folder.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(OmegaConf.structured(config), folder / CONFIG)


def stored_config(folder: Path, key: str) -> DictConfig:
    """The configuration of the run in a folder that ``key`` names; what it lacks has its default.

    Raises:
        InputError: it cannot be read, or another version has written it.
    """
    file = folder / CONFIG
    try:
        saved = cast(DictConfig, OmegaConf.load(file))
        if "algo" in saved:
            raise InputError("damian 0.1 wrote it, whose settings had other names: train again")
        schema = OmegaConf.structured(TrainConfig(learner=LEARNERS[saved.learner.name]()))
        return cast(DictConfig, OmegaConf.merge(schema, saved))
    except Exception as error:  # a damaged file can raise anything
        raise InputError(f"{key}: {file}: {one_line(error)}") from None


def load(checkpoint: Checkpoint, folder: Path, key: str, components: Collection[str] | None = None) -> None:
    """Restore a checkpoint, or some components of it, from a run folder that ``key`` names.

    Raises:
        InputError: it is incomplete, or of another configuration.
    """
    try:
        checkpoint.load(folder / CHECKPOINT, components=components)
    except Exception as error:  # a damaged file can raise anything
        raise InputError(f"{key}: {folder / CHECKPOINT}: {one_line(error)}") from error


def _resumed(folder: Path, overrides: Sequence[str]) -> DictConfig:
    allowed = ("resume=", "frames=", "episodes=")
    other = [word for word in overrides if not word.startswith(allowed)]
    if other:
        raise InputError(
            f"{other[0]}: a resumed run keeps its configuration; only {allowed[1]} and "
            f"{allowed[2]} may change"
        )
    for needed in (CONFIG, CHECKPOINT):
        if not (folder / needed).exists():
            raise InputError(f"resume: {folder} holds no {needed}, so there is nothing to go on with")
    changed = OmegaConf.from_dotlist(list(overrides))
    return cast(DictConfig, OmegaConf.merge(stored_config(folder, "resume"), changed))


_begun: list[bool] = []
"""Filled once Hydra has composed a configuration: what fails from then on is not a wrong command line."""


def reported(main: Callable[[DictConfig], None]) -> Callable[[DictConfig], None]:
    """Turn wrong input into one line on stderr and exit code 2, and leave no folder."""

    @functools.wraps(main)
    def checked_main(composed: DictConfig) -> None:
        _begun.append(True)
        try:
            main(composed)
        except (InputError, OmegaConfBaseException) as error:
            _drop_empty(Path(HydraConfig.get().runtime.output_dir))
            _give_up(error)

    return checked_main


def launch(main: Callable[[], Any], schema: type = TrainConfig) -> None:
    """Run a Hydra application; what Hydra refuses becomes one line on stderr and exit code 2."""
    set_schema(schema)
    _begun.clear()
    try:
        main()
    except COMPOSITION_ERRORS as error:
        if _begun:
            raise  # a bug, whose traceback is needed
        _give_up(error)


def _give_up(error: Exception) -> NoReturn:
    print(f"error: {one_line(error)}", file=sys.stderr)
    sys.exit(2)


def _drop_empty(folder: Path) -> None:
    """Remove a run folder that holds nothing, and the folders that Hydra made around it."""
    if not folder.is_dir() or any(folder.iterdir()):
        return
    folder.rmdir()
    around = folder.parent
    if [path.name for path in around.iterdir()] == ["multirun.yaml"]:
        (around / "multirun.yaml").unlink()
        _drop_empty(around)
    elif around.resolve() != Path.cwd() and not any(around.iterdir()):
        around.rmdir()
