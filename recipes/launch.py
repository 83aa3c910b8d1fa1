"""What every recipe shares: its typed configuration, and errors that are one line.

The configuration is a scenario (``damian.scenario``) plus how to learn in it.
"""

import difflib
import functools
import os
import re
import sys
import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any, NoReturn, cast

os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra raises; ``launch`` prints
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torchrl.checkpoint import Checkpoint

from damian import checks
from damian.clocks import SystemClock
from damian.delayed import is_late
from damian.delays import law_of
from damian.errors import InputError
from damian.mappo import MappoConfig
from damian.models import ModelConfig
from damian.runs import CHECKPOINT, CONFIG
from damian.scenario import ScenarioConfig, leftovers

CONF = str(Path(__file__).parents[1] / "conf")
"""Absolute, so that a recipe can be imported as well as run."""


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
    frames: int = 300_000
    """Steps to learn from, over all worlds."""
    episodes: int | None = None
    """Stop after so many episodes, if that comes first."""
    eval_episodes: int = 200
    """Episodes of each evaluation at the end."""
    checkpoint_every: int = 20
    """Updates between two checkpoints."""
    backupdate: bool = False
    """Put late messages in their place before learning from the steps that they belong to (SPEC 4): what the
    critic sees, rewards and ends of episodes; what the actor saw stays."""
    settle: bool = False
    """With ``backupdate``: learn from a step only when none of its messages can be under way any more."""
    recompute_actor: bool = False
    """The original authors' variant of ``backupdate``: late messages also rewrite what the actor saw and
    the probability of what it did, as if it had known."""
    checkpoint: str | None = None
    """Run folder whose policy to begin with; its overrides hold too, where no others are given."""
    overrides: list[str] = field(default_factory=list)
    """What was asked for on the command line; filled in by the recipe."""
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
        for name in ("worlds", "eval_episodes"):
            checks.in_range(name, getattr(self, name), 1, 1e6)
        for name in ("frames", "checkpoint_every"):
            checks.in_range(name, getattr(self, name), 1, 1e12)
        checks.in_range("threads", self.threads, 1, 1024)
        if self.episodes is not None:
            checks.in_range("episodes", self.episodes, 1)
        checks.device("device", self.device)

    def check_learning(self) -> None:
        """Make sure that it can be learnt like this; what is only flown need not.

        Raises:
            InputError: names the key that does not fit.
        """
        checks.in_range("algo.minibatches", self.algo.minibatches, 1, self.worlds * self.update_steps)
        # What is corrected are single rewards, and what the server knows at every step.
        others = {
            "delay.reward_window": (self.delay.reward_window, self.delay.reward_window > 1),
            "delay.rew": (self.delay.rew, is_late(self.delay.rew, self.clock.dt)),
            "clock.server": (self.clock.server, self.clock.steps("server") > 1),
        }
        for key, (value, set_) in others.items():
            should = "does not go with backupdate=true, which would undo it"
            checks.require(not (self.backupdate and set_), key, value, should)
        for key in ("settle", "recompute_actor"):
            alone = getattr(self, key) and not self.backupdate
            checks.require(not alone, key, True, "means nothing without backupdate=true")
        shortest = SystemClock(self.clock, self.update_steps).shortest
        should = (
            f"needs more than {self.longest_delay} steps, the longest delay, between two updates: {shortest}"
        )
        checks.require(not self.settle or self.longest_delay < shortest, "settle", True, should)

    @property
    def longest_delay(self) -> int:
        """Of a message [steps]."""
        return law_of(self.delay.obs).sampler(self.clock.dt).longest

    @property
    def update_steps(self) -> int:
        """Steps of every world before the first update: the system clock's, or the algorithm's."""
        return self.clock.steps("system") if self.clock.system else self.algo.steps

    @property
    def horizon(self) -> int:
        """Steps after which an evaluated episode is cut, if nothing else ends it."""
        limit = self.episode.max_steps or 200
        return 4 * limit if self.episode.since_detection else limit


ConfigStore.instance().store(name="schema", node=TrainConfig)
OmegaConf.register_new_resolver("shipped", lambda name: str(files("damian") / "data" / name))


def _plain(name: str) -> str:
    """A folder's name without quotes and brackets, and not too long for a file system."""
    plain = re.sub(r"[^\w.=,-]", "", name)
    return plain if len(plain) <= 100 else f"{plain[:90]}_{zlib.crc32(plain.encode()):08x}"


OmegaConf.register_new_resolver("plain", _plain)


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


def checked(written: DictConfig) -> TrainConfig:
    """The configuration of what was composed.

    Raises:
        InputError: a value is impossible, or a key means nothing.
    """
    config = OmegaConf.to_object(written)
    unknown = leftovers(written, config)
    if unknown:
        raise InputError(no_such_key(unknown[0]))
    return cast(TrainConfig, config)


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


_schema: list[type] = [TrainConfig]
"""Whose keys the program that runs knows."""


def launch(main: Callable[[], Any], schema: type = TrainConfig) -> None:
    """Run a Hydra application; what Hydra refuses becomes one line on stderr and exit code 2."""
    _schema[0] = schema
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
    known = [str(name) for name in _keys(OmegaConf.structured(_schema[0]))]
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.75)
    return f"{key}: no such key" + (f"; did you mean {near[0]}?" if near else "")


def _keys(config: DictConfig, path: str = "") -> Iterator[str]:
    """Every dotted key of a configuration."""
    for name in config:
        yield f"{path}{name}"
        node = config._get_node(name)
        if isinstance(node, DictConfig) and not node._is_missing():
            yield from _keys(config[name], f"{path}{name}.")
