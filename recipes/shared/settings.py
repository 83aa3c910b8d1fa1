"""Everything that the recipes can be told: a scenario (``damian.scenario``), and how to learn in it."""

import os
import re
import zlib
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from damian.common import checks
from damian.envs.clocks import SystemClock
from damian.envs.pipeline import is_late
from damian.envs.scenario import ScenarioConfig
from damian.envs.uav_env import PRIVILEGED
from damian.learners.mappo import MappoConfig
from damian.learners.networks import ModelConfig
from damian.learners.sac import SacConfig

CONF = str(Path(__file__).parents[2] / "conf")
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

    algo: str = "mappo"
    """mappo or sac."""
    mappo: MappoConfig = field(default_factory=MappoConfig)
    sac: SacConfig = field(default_factory=SacConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    critic: str = "server"
    """What the critic sees: what the ``server`` holds, or ``privileged``, what is true (regime R1)."""
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
        checks.one_of("algo", self.algo, ("mappo", "sac"))
        checks.one_of("critic", self.critic, ("server", "privileged"))
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
        checked = {"mappo": self._check_mappo, "sac": self._check_sac}
        checked[self.algo]()
        self._check_skip()
        held = self.delay.hold == "max" and self.longest_delay == 0
        checks.require(not held, "delay.hold", "max", "means nothing without late messages (delay.obs)")
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

    def _check_mappo(self) -> None:
        shortest, recurrent = SystemClock(self.clock, self.update_steps).shortest, self.model.recurrent
        most = self.worlds if recurrent else self.worlds * shortest
        checks.in_range("mappo.minibatches", self.mappo.minibatches, 1, most)
        longest = self.longest_delay
        should = f"needs more than {longest} steps, the longest delay, between two updates: {shortest}"
        checks.require(not self.settle or longest < shortest, "settle", True, should)
        should = "does not go with model.rnn: what a UAV remembers is not corrected"
        checks.require(not (recurrent and self.recompute_actor), "recompute_actor", True, should)

    def _check_sac(self) -> None:
        should = "is for algo=mappo only: SAC learns from single decisions, without what came before them"
        checks.require(not self.model.recurrent, "model.rnn", self.model.rnn, should)
        should = "is for algo=mappo only: SAC has no importance ratios"
        checks.require(not self.recompute_actor, "recompute_actor", True, should)
        least = SystemClock(self.clock, self.update_steps).longest + 2 * self.longest_delay
        checks.in_range("sac.memory", self.sac.memory, self.worlds * least, unit="steps")
        room = self.sac.memory // self.worlds * self.worlds
        checks.in_range("sac.warm_up", self.sac.warm_up, 0, room, unit="steps")

    def _check_skip(self) -> None:
        should = "does not go with model.rnn: a flight is remembered at every step, not only at decisions"
        checks.require(not (self.model.recurrent and self.clock.skip), "clock.skip", True, should)
        discount, should = self.clock.skip_discount, "is that of the algorithm while it learns; leave it out"
        checks.require(discount == 1, "clock.skip_discount", discount, should)

    @property
    def longest_delay(self) -> int:
        """Of a message [steps]."""
        return self.delay.uplink.sampler(self.clock.dt).longest

    @property
    def critic_sees(self) -> str:
        """Name of the entry that the critic reads."""
        return PRIVILEGED if self.critic == "privileged" else "global_observation"

    @property
    def update_steps(self) -> int:
        """Steps of every world before the first update: the system clock's, or the algorithm's."""
        return self.clock.steps("system") if self.clock.system else getattr(self, self.algo).steps

    @property
    def flown(self) -> ScenarioConfig:
        """What an evaluation flies: every step, for its measures."""
        return replace(self, clock=replace(self.clock, skip=False, skip_discount=1.0))

    @property
    def learnt(self) -> ScenarioConfig:
        """What is trained in: rewards of skipped steps are discounted as the learner does."""
        discount = getattr(self, self.algo).gamma if self.clock.skip else 1.0
        return replace(self, clock=replace(self.clock, skip_discount=discount))

    @property
    def unseen_seed(self) -> int:
        """Of the situations that a policy is evaluated in, and not trained."""
        return self.seed + 10_000

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
