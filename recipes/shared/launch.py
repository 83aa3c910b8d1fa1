"""What every recipe shares: from a command line to a checked configuration, and errors that are one line."""

import difflib
import functools
import os
import re
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn, cast

os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra raises; ``launch`` prints
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torchrl.checkpoint import Checkpoint

from damian.common.errors import InputError
from damian.envs.scenario import leftovers
from damian.evaluation.run_folder import CHECKPOINT, CONFIG
from shared.settings import CONF, TrainConfig


def prepare(written: DictConfig) -> tuple[TrainConfig, Path]:
    """The checked configuration of what Hydra composed, and the run folder.

    A resumed run goes on in its own folder with its own configuration; only how long it lasts may change.

    Raises:
        InputError: a value is impossible, a key means nothing, or there is nothing to resume.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    if written.resume is not None:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            raise InputError("resume: one run goes on at a time; leave out -m")
        _drop_empty(folder)
        folder = Path(written.resume)
        written = _resumed(folder, HydraConfig.get().overrides.task)
    elif (folder / CONFIG).exists():
        raise InputError(f"hydra.run.dir: {folder} holds a run already; resume={folder} goes on with it")
    config = checked(written)
    if config.resume is None:
        config.overrides = list(HydraConfig.get().overrides.task)
    return config, folder


def perform(config: TrainConfig, folder: Path, program: Callable[[TrainConfig, Path], None]) -> None:
    """Run a program with its threads and its seed."""
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    program(config, folder)


def checked(written: DictConfig) -> Any:
    """The configuration of what was composed, as its schema says: a ``TrainConfig``, or another one.

    Raises:
        InputError: a value is impossible, or a key means nothing.
    """
    config = OmegaConf.to_object(written)
    unknown = leftovers(written, config)
    if unknown:
        raise InputError(no_such_key(unknown[0]))
    return config


def save_config(config: TrainConfig, folder: Path) -> None:
    """Write the resolved configuration into the run folder."""
    folder.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(OmegaConf.structured(config), folder / CONFIG)


def load(checkpoint: Checkpoint, folder: Path, key: str, parts: Collection[str] | None = None) -> None:
    """Restore a checkpoint, or some parts of it, from a run folder that ``key`` names.

    Raises:
        InputError: it is incomplete, or of another configuration.
    """
    try:
        checkpoint.load(folder / CHECKPOINT, components=parts)
    except Exception as error:  # whatever a spoilt file makes of itself
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
    try:
        saved = OmegaConf.merge(OmegaConf.structured(TrainConfig), OmegaConf.load(folder / CONFIG))
    except Exception as error:
        raise InputError(f"resume: {folder / CONFIG}: {one_line(error)}") from None
    return cast(DictConfig, OmegaConf.merge(saved, OmegaConf.from_dotlist(list(overrides))))


_begun: list[bool] = []
"""Filled once Hydra has composed a configuration: what fails from then on is not a wrong command line."""


def reported(main: Callable[[DictConfig], None]) -> Callable[[DictConfig], None]:
    """Turn what a person got wrong into one line on stderr and exit code 2, and leave no folder."""

    @functools.wraps(main)
    def checked(written: DictConfig) -> None:
        _begun.append(True)
        try:
            main(written)
        except (InputError, OmegaConfBaseException) as error:
            _drop_empty(Path(HydraConfig.get().runtime.output_dir))
            _give_up(error)

    return checked


_schemas: list[type] = [TrainConfig]
"""Whose keys the program that runs knows, its own first."""


def launch(main: Callable[[], Any], schema: type = TrainConfig) -> None:
    """Run a Hydra application; what Hydra refuses becomes one line on stderr and exit code 2."""
    _schemas[:] = dict.fromkeys([schema, TrainConfig])
    _begun.clear()
    try:
        words = sorted(sys.argv[1:], key=lambda word: word not in ("-m", "--multirun"))  # flags first
        sys.argv[1:] = quoted(inherited(words))
        main()
    except (HydraException, OmegaConfBaseException, ValueError, TypeError, OSError) as error:
        if _begun:
            raise  # no wrong input but our mistake: its traceback is needed
        _give_up(error)


def inherited(words: list[str]) -> list[str]:
    """Overrides, and those of the run whose ``checkpoint`` they name, where they give no others.

    Raises:
        InputError: the run's configuration cannot be read.
    """
    value = next((word.partition("=")[2] for word in words if word.startswith("checkpoint=")), "")
    file = Path(value.strip("'\"")) / CONFIG
    if "," in value and value[:1] not in "'\"":
        raise InputError("checkpoint: one at a time, as each run brings its overrides along")
    if not value or not file.is_file():
        return words  # whoever wants to load it will say so
    try:
        saved = cast(list[str], OmegaConf.to_container(OmegaConf.load(file))["overrides"])  # type: ignore
        given = [_key(word) for word in words]
        return words + [word for word in saved if not any(_sets(key, _key(word)) for key in given)]
    except Exception as error:  # whatever a spoilt file makes of itself
        raise InputError(f"checkpoint: {file}: {one_line(error)}") from error


def _key(override: str) -> str:
    return override.lstrip("+~").partition("=")[0]


def _sets(given: str, key: str) -> bool:
    """Does an override of the one, perhaps a group, also decide about the other?"""
    return key == given or key.startswith(f"{given}.")


def _give_up(error: Exception) -> NoReturn:
    print(f"error: {one_line(error)}", file=sys.stderr)
    sys.exit(2)


def quoted(words: list[str]) -> list[str]:
    """Overrides with quotes where an option of a group looks like a number, or like nothing, to Hydra."""
    groups = "|".join(folder.name for folder in Path(CONF).iterdir() if folder.is_dir())
    return [re.sub(rf"^(\+?(?:{groups})=)([\d,]+|null)$", _with_quotes, word) for word in words]


def _with_quotes(match: re.Match[str]) -> str:
    return match[1] + ",".join(f"'{number}'" for number in match[2].split(","))


def _drop_empty(folder: Path) -> None:
    """Remove a run folder that holds nothing, and what Hydra made around it."""
    if not folder.is_dir() or any(folder.iterdir()):
        return
    folder.rmdir()
    around = folder.parent
    if [path.name for path in around.iterdir()] == ["multirun.yaml"]:
        (around / "multirun.yaml").unlink()
        _drop_empty(around)
    elif around.resolve() != Path.cwd() and not any(around.iterdir()):
        around.rmdir()


def one_line(error: BaseException) -> str:
    """What is wrong, from the deepest cause, without Hydra's tails of types, paths and hints."""
    while isinstance(error.__cause__, OmegaConfBaseException):
        error = error.__cause__
    text, _, _ = str(error).partition("Config search path")
    key = re.search(r"full_key: (\S+)", text)
    if key and re.search(r"Key '.*' (is )?not in ", text):
        return no_such_key(key[1])
    tails = ("full_key", "reference_type", "object_type", "Set the env")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    told, *more = [line for line in lines if not line.startswith(tails)] or [type(error).__name__]
    told = " ".join([told, ", ".join(more).replace(":,", ":")]).strip()
    return f"{key[1]}: {told}" if key else told


def no_such_key(key: str) -> str:
    """The message for an unknown key, with the nearest known one."""
    if re.match(r"delay\.(obs|act|rew)\.", key):
        return f"{key}: no setting of the law that is there already; write another law over delay=none"
    near = (
        difflib.get_close_matches(key, map(str, _keys(OmegaConf.structured(schema))), n=1, cutoff=0.75)
        for schema in _schemas
    )
    nearest = next(filter(None, near), [])
    return f"{key}: no such key" + "".join(f"; did you mean {name}?" for name in nearest)


def _keys(config: DictConfig, path: str = "") -> Iterator[str]:
    """Every dotted key of a configuration."""
    for name in config:
        yield f"{path}{name}"
        node = config._get_node(name)
        if isinstance(node, DictConfig) and not node._is_missing():
            yield from _keys(config[name], f"{path}{name}.")
