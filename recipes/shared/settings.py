"""All settings of the recipes: those of a scenario (``damian.envs.scenario``), and those of the training."""

import re
import zlib
from dataclasses import dataclass, field, replace
from typing import Any

from hydra.core.config_store import ConfigNode, ConfigStore
from omegaconf import MISSING, OmegaConf

from damian import keys
from damian.common import checks
from damian.common.threads import available_cores
from damian.delays.config import DelayConfig
from damian.envs.pipeline import has_delay, has_message_delay
from damian.envs.scenario import ScenarioConfig
from damian.learners.base import LEARNERS, LearnerConfig, LearningSetup
from damian.learners.mappo import MappoConfig
from damian.learners.networks import ModelConfig
from damian.learners.predictive_mappo import PredictiveMappoConfig
from damian.learners.schedule import SystemClock
from damian.runs.loggers import check_loggers

MAX_BATCH = 100_000_000
"""Most environment steps, over all worlds, that are collected before an update; they lie in memory."""


COLLECTORS = ("sync", "process", "ray")


@dataclass
class LoggerConfig:
    """Which files of metrics the training writes into the run folder."""

    tensorboard: bool = True
    """Write TensorBoard events."""
    csv: bool = True
    """Write ``metrics.csv``."""
    film_every: int = 0
    """Updates from one film of an evaluation's episode to the next, in ``films/`` and TensorBoard; 0: none. A
    film takes several seconds."""
    custom: list[Any] = field(default_factory=list)
    """Loggers of one's own, each ``package.module:Name``, or ``{logger: package.module:Name, ...}`` with its
    parameters."""

    def __post_init__(self) -> None:
        checks.in_range("logger.film_every", self.film_every, 0, 1e12)
        check_loggers(self.custom)


@dataclass
class TrainConfig(ScenarioConfig):
    """All settings of ``damian train``, beside those of the scenario."""

    learner: LearnerConfig = field(default_factory=MappoConfig)
    """Settings of the learner: ``MappoConfig``, ``SacConfig``, or a class of one's own."""
    model: ModelConfig = field(default_factory=ModelConfig)
    """Networks of actor and critic."""
    critic: str = "server"
    """The critic observes the messages that the ``server`` holds, or (``privileged``) the true state without
    delay (regime R1, docs/protocol.md)."""
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    seed: int = 0
    """Seed of all random draws."""
    worlds: int = 64
    """Number of parallel environments."""
    frames: int = 300_000
    """Environment steps to learn from, over all worlds."""
    episodes: int | None = None
    """Stop training after this number of episodes, if that comes before ``frames``."""
    eval_episodes: int = 200
    """Episodes of each evaluation after the training."""
    checkpoint_every: int = 20
    """Updates between two checkpoints: what a killed run loses at most."""
    backupdate: bool = False
    """Back-updating (paper, section 3.4): late messages correct stored steps before the learner uses them.
    They correct the critic's observations, rewards and ends of episodes, but not the actor's observations. A
    late reward (``delay.rew``) counts for the step that earned it, as soon as it has been paid."""
    settle: bool = False
    """With ``backupdate``: learn from a step only when neither its messages nor its reward can be in transit
    any more."""
    recompute_actor: bool = False
    """With ``backupdate``, the original authors' variant: late messages correct the actor's observations too,
    and the log-probabilities of its actions follow from these."""
    checkpoint: str | None = None
    """Run folder of a policy, or the ``best.pt`` in it: the one with which a training begins, or that another
    program flies. That run's overrides apply too, unless others are given."""
    overrides: list[str] = field(default_factory=list)
    """Overrides on the command line; the program fills them in."""
    resume: str | None = None
    """Run folder of the run to continue."""
    device: str = "cpu"
    """Device of all tensors: cpu, cuda, cuda:1, ..."""
    threads: int | None = None
    """Number of threads with which the networks learn; all cores if not given. The worlds always step with
    one, because their tensors are small. Another number of threads gives other rounding errors."""
    collector: str = "sync"
    """Where the worlds step: in this process (``sync``), in ``workers`` processes of this machine
    (``process``), or in ``workers`` Ray actors (``ray``), on the cluster of ``RAY_ADDRESS`` or else on this
    machine. The workers get the weights of the actor before every batch (docs/scaling.md)."""
    workers: int = 1
    """Number of workers, among which the worlds are divided evenly, with ``collector=process`` or ``ray``;
    each needs a core. The worlds are those of ``collector=sync``; actions are drawn from a generator for
    each worker, whose seed follows from ``seed`` and the worker's number."""
    compile: bool = False
    """Compile the environment's step, the actor's, and the loss of MAPPO (unless ``model.rnn`` is set). The
    program then begins half a minute later, or a few seconds if it has run before; this pays off from about a
    million environment steps on."""

    def __post_init__(self) -> None:
        super().__post_init__()
        matches = type(self.learner) is LEARNERS.get(self.learner.name, "learner")
        should = f"is not the learner of these settings: choose one with learner={'|'.join(LEARNERS)}"
        checks.require(matches, "learner.name", self.learner.name, should)
        checks.one_of("critic", self.critic, ("server", "privileged"))
        checks.one_of("collector", self.collector, COLLECTORS)
        checks.in_range("workers", self.workers, 1, 1024)
        checks.in_range("seed", self.seed, 0, 2**31)
        for name in ("worlds", "eval_episodes"):
            checks.in_range(name, getattr(self, name), 1, checks.WORLDS)
        for name in ("frames", "checkpoint_every"):
            checks.in_range(name, getattr(self, name), 1, 1e12)
        if self.threads is not None:
            checks.in_range("threads", self.threads, 1, 1024)
        if self.episodes is not None:
            checks.in_range("episodes", self.episodes, 1, 1e12)
        checks.device("device", self.device)
        if not self.seeks_source:
            self._leave_out_belief()

    def _leave_out_belief(self) -> None:
        """Observe no belief about a source by which nothing is won: ``aware=belief`` suits any task."""
        self.observation = replace(self.observation, belief=[])
        self.model = replace(self.model, skip=False)

    def check_learning(self) -> None:
        """Check that the settings allow training; an evaluation has fewer requirements.

        Raises:
            InputError: names the key that does not fit.
        """
        setup = self.learning_setup
        batch, should = setup.worlds * setup.longest_period, "environment steps between two updates"
        checks.in_range("worlds", batch, 1, MAX_BATCH, should)
        self.learner.check(setup)
        self._check_skip()
        self._check_backupdate()
        self._check_workers()
        self._check_delay()

    def _check_delay(self) -> None:
        """Check that no setting of the delays is without any effect."""
        delay, name = self.delay, self.learner.name
        at_once, should = self.longest_delay == 0, "means nothing without delayed messages (delay.obs)"
        checks.require(not (at_once and delay.hold == "max"), "delay.hold", "max", should)
        # Links other than the server's have a delay of their own, to which the order applies too.
        useless = at_once and self.links.kind == "server" and delay.order == "arrival"
        checks.require(not useless, "delay.order", "arrival", should)
        useless = delay.reward_window == 1 and delay.reward_discount != DelayConfig.reward_discount
        should = "means nothing with delay.reward_window=1, which sums no rewards; leave it out"
        checks.require(not useless, "delay.reward_discount", delay.reward_discount, should)
        unread = delay.messages and ":" not in name and not isinstance(self.learner, PredictiveMappoConfig)
        should = f"is not read by learner={name}; choose learner=predictive_mappo, or leave it out"
        checks.require(not unread, "delay.messages", delay.messages, should)

    def _check_backupdate(self) -> None:
        """Check what goes with back-updating only, and what it needs."""
        hindsight = "hindsight" in self.learner.reads and not (self.backupdate and has_message_delay(self))
        should = "reads hindsight, which needs aware=backupdate and a message delay (delay.obs)"
        checks.require(not hindsight, "learner", self.learner.name, should)
        onboard = self.recompute_actor and self.links.kind != "server"
        should = (
            f"does not go with links={self.links.kind}: an actor sees what the links bring, not the server"
        )
        checks.require(not onboard, "recompute_actor", True, should)
        for key in ("settle", "recompute_actor"):
            alone = getattr(self, key) and not self.backupdate
            checks.require(not alone, key, True, "means nothing without backupdate=true")

    def _check_workers(self) -> None:
        sync = self.collector == "sync"
        alone, should = sync and self.workers > 1, "means nothing with collector=sync; choose process or ray"
        checks.require(not alone, "workers", self.workers, should)
        should = f"does not divide worlds={self.worlds}: every worker has as many worlds as the others"
        checks.require(self.worlds % self.workers == 0, "workers", self.workers, should)
        should = f"steps on processors; device={self.device} needs collector=sync"
        checks.require(sync or self.device == "cpu", "collector", self.collector, should)

    def _check_skip(self) -> None:
        should = "does not go with model.rnn: hidden states change at every step, not only at decisions"
        checks.require(not (self.model.recurrent and self.clock.skip), "clock.skip", True, should)
        discount, should = self.clock.skip_discount, "is set to learner.gamma in training; leave it out"
        checks.require(discount == 1, "clock.skip_discount", discount, should)

    @property
    def learning_threads(self) -> int:
        """Number of threads with which the networks learn."""
        return self.threads or available_cores()

    @property
    def late(self) -> list[str]:
        """Settings by which messages, actions or rewards are late."""
        late = [f"delay.{name}" for name in ("act", "rew") if has_delay(self, name)]
        return [*["delay.obs"] * has_message_delay(self), *late]

    @property
    def longest_delay(self) -> int:
        """Longest delay of a message [steps]."""
        return self.delay.sampler("obs", self.clock.dt).longest

    @property
    def longest_wait(self) -> int:
        """Longest time until all that corrects a step has arrived: its messages, and its reward [steps]."""
        late_reward = self.delay.sampler("rew", self.clock.dt).longest
        return max(self.longest_delay, late_reward) if self.backupdates else self.longest_delay

    @property
    def action_delay(self) -> int | None:
        """Delay of every action [steps of the training]; None if it differs between actions."""
        delay = self.delay.sampler("act", self.clock.dt).constant_delay
        return None if delay and self.clock.skip else delay  # a step of the training then has any length

    @property
    def update_steps(self) -> int:
        """Steps of every world before the first update: the system clock's period, or ``learner.steps``."""
        return self.clock.steps("system") if self.clock.system else self.learner.steps

    @property
    def learning_setup(self) -> LearningSetup:
        """The settings of this run that a learner needs beside its own."""
        clock = SystemClock(self.clock, self.update_steps)
        return LearningSetup(
            model=self.model,
            worlds=self.worlds,
            shortest_period=clock.shortest,
            longest_period=clock.longest,
            longest_delay=self.longest_wait,
            backupdate=self.backupdates,
            settle=self.settle,
            recompute_actor=self.recompute_actor,
            critic_key=keys.PRIVILEGED_OBSERVATION
            if self.critic == "privileged"
            else keys.GLOBAL_OBSERVATION,
            compile=self.compile,
            frames=self.frames,
            action_delay=self.action_delay,
        )

    @property
    def backupdates(self) -> bool:
        """Is back-updating switched on, and can any message or reward be late or lost?"""
        return self.backupdate and (has_message_delay(self) or has_delay(self, "rew"))

    @property
    def eval_scenario(self) -> ScenarioConfig:
        """The scenario of an evaluation; it skips no steps, because every step is measured."""
        return replace(self, clock=replace(self.clock, skip=False, skip_discount=1.0))

    @property
    def train_scenario(self) -> ScenarioConfig:
        """The scenario of the training; rewards of skipped steps are discounted by ``learner.gamma``."""
        discount = self.learner.gamma if self.clock.skip else 1.0
        return replace(self, clock=replace(self.clock, skip_discount=discount))

    @property
    def eval_seed(self) -> int:
        """Seed of the initial conditions of an evaluation; they differ from those of the training."""
        return self.seed + 10_000

    @property
    def horizon(self) -> int:
        """Steps after which an episode of an evaluation is cut off, if nothing else ends it."""
        limit = self.episode.max_steps or 200
        return 4 * limit if self.episode.since_detection else limit


_STORE = ConfigStore.instance()


def store_schema(name: str, settings: type[TrainConfig]) -> None:
    """Give Hydra the settings of a program under the name that its file in conf/ lists."""
    schema = OmegaConf.structured(settings)
    schema.learner = MISSING  # the group ``learner`` fills it in, with settings of any class
    _STORE.store(name=name, node=schema)


store_schema("schema", TrainConfig)
for _name, _config in LEARNERS.items():
    _STORE.store(group="schema/learner", name=_name, node=_config)


class _OwnLearners(dict[str, ConfigNode]):
    """The options ``package.module:Name`` of Hydra's group ``learner``, imported when they are chosen."""

    def __contains__(self, option: object) -> bool:
        return ":" in str(option) or super().__contains__(option)

    def __getitem__(self, option: str) -> ConfigNode:
        path = option.removesuffix(".yaml")
        settings = LEARNERS.get(path, "learner")
        return ConfigNode(option, OmegaConf.structured(settings(name=path)), "learner", None, "damian")


_STORE.repo["learner"] = _OwnLearners()


def _plain(name: str) -> str:
    """A folder's name without quotes, brackets and slashes, short enough for a file system."""
    plain = re.sub(r"[^\w.=,-]", "", name.replace("/", "-"))
    return plain if len(plain) <= 100 else f"{plain[:90]}_{zlib.crc32(plain.encode()):08x}"


OmegaConf.register_new_resolver("plain", _plain)
