"""What every recipe shares: its typed configuration, and errors that are one line.

The configuration is a scenario (``damian.scenario``) plus how to learn in it.
"""

import os
import re
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any, cast

os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra raises; ``launch`` prints
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from damian import checks
from damian.errors import InputError
from damian.losses import MappoConfig
from damian.models import ModelConfig
from damian.runs import CHECKPOINT, CONFIG
from damian.scenario import ScenarioConfig, leftovers


@dataclass
class LoggerConfig:
    """Where the curves go, inside the run folder."""

    tensorboard: bool = True
    """TensorBoard events."""
    csv: bool = True
    """``metrics.csv``."""


@dataclass
class TrainConfig(ScenarioConfig):
    """Everything that ``recipes/train.py`` can be told."""

    algo: MappoConfig = field(default_factory=MappoConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    seed: int = 0
    """Of everything that is drawn."""
    worlds: int = 64
    """Worlds that are stepped together."""
    frames: int = 400_000
    """Steps to learn from, over all worlds."""
    episodes: int | None = None
    """Stop after so many episodes, if that comes first."""
    eval_episodes: int = 200
    """Episodes of each evaluation at the end."""
    checkpoint_every: int = 20
    """Updates between two checkpoints."""
    resume: str | None = None
    """Run folder to go on with."""
    device: str = "cpu"
    """cpu, cuda, cuda:1, ..."""
    threads: int = 1
    """Threads of torch; small tensors are slower with more."""
    compile: bool = False
    """Compile the environment's step: worth it from some hundred worlds on."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.in_range("seed", self.seed, 0, 2**31)
        for name in ("worlds", "frames", "eval_episodes", "checkpoint_every", "threads"):
            checks.in_range(name, getattr(self, name), 1)
        if self.episodes is not None:
            checks.in_range("episodes", self.episodes, 1)
        batch = self.worlds * self.algo.steps
        checks.require(
            batch % self.algo.minibatches == 0,
            "algo.minibatches",
            self.algo.minibatches,
            f"does not divide a batch of worlds x algo.steps = {batch}",
        )

    @property
    def horizon(self) -> int:
        """Steps after which an evaluated episode is cut, if nothing else ends it."""
        limit = self.episode.max_steps or 200
        return 4 * limit if self.episode.since_detection else limit


ConfigStore.instance().store(name="schema", node=TrainConfig)
OmegaConf.register_new_resolver("shipped", lambda name: str(files("damian") / "data" / name))


def prepare(written: DictConfig) -> tuple[TrainConfig, Path]:
    """The checked configuration of what Hydra composed, and the run folder.

    A resumed run goes on in its own folder with its own configuration; only how long it lasts may change.

    Raises:
        InputError: a value is impossible, a key means nothing, or there is nothing to resume.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    if written.resume is not None:
        _drop_empty(folder)
        folder = Path(written.resume)
        written = _resumed(folder, HydraConfig.get().overrides.task)
    config = OmegaConf.to_object(written)
    unknown = leftovers(written, config)
    if unknown:
        raise InputError(f"{unknown[0]}: no such key")
    return cast(TrainConfig, config), folder


def save_config(config: TrainConfig, folder: Path) -> None:
    """Write the resolved configuration into the run folder."""
    folder.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(OmegaConf.structured(config), folder / CONFIG)


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
            raise InputError(
                f"resume: {folder} holds no {needed}, so there is nothing to go on with"
            )
    saved = OmegaConf.merge(OmegaConf.structured(TrainConfig), OmegaConf.load(folder / CONFIG))
    return cast(DictConfig, OmegaConf.merge(saved, OmegaConf.from_dotlist(list(overrides))))


def launch(recipe: Callable[[], Any]) -> None:
    """Run a Hydra application; what a person got wrong becomes one line on stderr and exit code 2."""
    # Hydra reads a bare number as an integer, which no config group may be called.
    sys.argv = [re.sub(r"^(\+?usecase=)([\d,]+)$", _quoted, word) for word in sys.argv]
    try:
        recipe()
    except (InputError, HydraException, OmegaConfBaseException) as error:
        if HydraConfig.initialized():
            _drop_empty(Path(HydraConfig.get().runtime.output_dir))
        print(f"error: {_one_line(error)}", file=sys.stderr)
        sys.exit(2)


def _quoted(match: re.Match[str]) -> str:
    return match[1] + ",".join(f"'{number}'" for number in match[2].split(","))


def _drop_empty(folder: Path) -> None:
    """Remove a run folder in which nothing has been written."""
    if folder.is_dir() and not any(path.is_file() for path in folder.rglob("*")):
        shutil.rmtree(folder)


def _one_line(error: Exception) -> str:
    """The message without Hydra's tail of types and hints."""
    cause = error.__cause__ if isinstance(error.__cause__, InputError) else error
    lines = [line.strip() for line in str(cause).splitlines()]
    keep = [
        line for line in lines if line and not line.startswith(("reference_type", "object_type"))
    ]
    keys = [line.removeprefix("full_key: ") for line in keep if line.startswith("full_key: ")]
    text = "; ".join(line for line in keep if not line.startswith(("full_key", "Set the env")))
    return f"{keys[0]}: {text}" if keys and keys[0] not in text else text
