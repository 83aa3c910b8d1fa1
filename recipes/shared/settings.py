"""What follows from the settings of a training: its delays, what a learner needs, and what does not
fit."""

from damian import keys
from damian.common import checks
from damian.delays.scenario import ScenarioDelays
from damian.learners.config import LearningSetup
from damian.learners.schedule import SystemClock
from damian.runs.measures import METRICS
from damian.runs.metrics_log import read_logger
from damian.server.features.base import check_features
from damian.server.rewards import terms_of
from damian.world.regions.sources import REGION_SOURCES
from damian.world.sensors import sensors_of
from damian.world.vehicles import MOTION_MODELS

from ..config import TrainConfig


def late(delays: ScenarioDelays) -> list[str]:
    """Settings by which messages, actions or rewards are late."""
    return [f"delay.{name}" for name in ("obs", "act", "rew") if getattr(delays, name).late]


def measures_hindsight(delays: ScenarioDelays) -> bool:
    """Whether messages or rewards are late."""
    return delays.obs.late or delays.rew.late


def backupdates(config: TrainConfig, delays: ScenarioDelays) -> bool:
    """Is back-updating switched on, and can any message or reward be late or lost?"""
    return config.backupdate and measures_hindsight(delays)


def learning_setup(config: TrainConfig, delays: ScenarioDelays) -> LearningSetup:
    """The settings of a run that a learner needs beside its own."""
    clock = SystemClock(config.clock, config.update_steps)
    privileged = config.critic == "privileged"
    return LearningSetup(
        model=config.model,
        worlds=config.worlds,
        shortest_period=clock.shortest,
        longest_period=clock.longest,
        longest_delay=delays.longest,
        backupdate=backupdates(config, delays),
        settle=config.settle,
        recompute_actor="actor" in config.corrected,
        critic_key=keys.PRIVILEGED_OBSERVATION if privileged else keys.GLOBAL_OBSERVATION,
        compile=config.compiles,
        frames=config.frames,
        action_delay=delays.act.arrival_delay,
    )


def check_components(config: TrainConfig) -> ScenarioDelays:
    """Check that the device and all components exist that the settings name, which imports them."""
    checks.device("device", config.device)
    REGION_SOURCES.get(config.region.kind, "region.kind")
    MOTION_MODELS.get(config.motion.kind, "motion.kind")
    delays = config.make_delays()
    check_features(config.observation)
    terms_of(config.reward)
    sensors_of(config.sensors)
    for name in config.metrics:
        METRICS.get(name, "metrics")
    for written in config.logger.custom:
        read_logger(written)
    return delays


def check_learning(config: TrainConfig) -> None:
    """Check that the settings allow training; an evaluation has fewer requirements."""
    delays = check_components(config)
    config.learner.check(learning_setup(config, delays))
    _check_backupdate(config, delays.obs.late)
    messages = config.delay.messages
    name = config.learner.name
    checks.require(
        not messages or "timeline" in config.learner.reads,
        "delay.messages",
        messages,
        f"is not read by learner={name}, whose reads have no timeline: leave it out",
    )


def _check_backupdate(config: TrainConfig, late_messages: bool) -> None:
    """Check what goes with back-updating only, and what it needs."""
    no_messages = not (config.backupdate and late_messages)
    problem = "reads hindsight, which needs aware=backupdate and a message delay (delay.obs)"
    unable = "hindsight" in config.learner.reads and no_messages
    checks.require(not unable, "learner", config.learner.name, problem)
    onboard = "actor" in config.corrected and config.links.kind != "server"
    checks.require(
        not onboard,
        "corrected",
        config.corrected,
        f"does not go with links={config.links.kind}: an actor sees what links bring, not the "
        "server",
    )
    for key, default in (("settle", False), ("corrected", ["reward", "critic"])):
        alone = getattr(config, key) != default and not config.backupdate
        checks.require(
            not alone, key, getattr(config, key), "means nothing without backupdate=true"
        )
