"""The parts of a training: environment, learner, replay buffer, and batches between ticks of its
clock."""

import math
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.data import ReplayBuffer
from torchrl.envs import TransformedEnv

from damian import keys
from damian.baselines.script import assumed_script
from damian.common import checks
from damian.common.compiling import COMPILE_OPTIONS
from damian.common.errors import naming_errors
from damian.delays.scenario import ScenarioDelays
from damian.envs.delayed_env import DelayedEnv
from damian.envs.forward import assumed_policy
from damian.envs.nodes import EpisodeTotals
from damian.envs.pipeline import make_env
from damian.envs.recompute import CORRECTED, server_recompute
from damian.learners.base import Learner, undelayed_talk
from damian.learners.config import LearnerConfig
from damian.learners.schedule import SystemClock
from damian.models.memory import add_recurrent_state
from damian.replay.backupdate import BackupdateStorage, corrections_of
from damian.replay.time_storage import TimeStorage
from damian.runs.metrics import HindsightReturns
from damian.server.server import Server
from damian.world.simulation import Simulation

from ..config import TrainConfig
from .settings import backupdates, learning_setup, measures_hindsight


def learning_env(config: TrainConfig) -> DelayedEnv:
    """The environment of the training, [B], with what the learner and the logs need."""
    triggered = config.clock.trigger is not None
    messages = measures_hindsight(config.make_delays()) or triggered
    privileged = config.critic == "privileged"
    reads = {*config.learner.reads} - {
        "hindsight",
        "timeline",
    }  # from the storage, and delay.messages
    extras = {"reward_terms", *["message"] * messages, *["privileged"] * privileged, *reads}
    env = make_env(config, config.worlds, config.seed, config.device, extras)
    assume(config, env)
    if config.compiles:
        env.compile()
    env.append_transform(EpisodeTotals())
    return env


def assume(
    config: TrainConfig, env: DelayedEnv, policy: TensorDictModuleBase | None = None
) -> None:
    """Say what everybody is assumed to do where late messages are flown forward: what the policy
    does, if there is one and the settings ask for it, or else what the script does."""
    forward = config.observation.forward
    if forward == "policy" and policy is not None:
        env.assume(assumed_policy(env.uav_env.simulation, env.server, policy))
    elif forward:
        env.assume(assumed_script(env))


def map_summary(simulation: Simulation) -> str:
    """What was read of a map: its area, its landing points and how many footprints it has room for.

    A warning follows if these are fewer than the UAVs, or more than a hundred times as many.
    """
    region = simulation.airspace.regions[0]
    radius = simulation.radius
    agents = simulation.config.agents
    area = region.polygon.area
    fitting = area / (math.pi * radius**2)
    n_points = int(simulation.airspace.n_points[0])
    told = f"region: {region.name}: {area / 1e6:.3g} km², {n_points} landing points, "
    told += f"room for {fitting:.3g} footprints of {radius:.3g} m"
    if agents <= fitting <= 100 * agents:
        return told
    return f"{told}\nwarning: footprints do not fit agents={agents}; source.level_db sets them"


def own_code(learner: LearnerConfig) -> AbstractContextManager[None]:
    """A context that names a learner of the user's own in errors; a built-in one keeps its
    traceback."""
    built_in = type(learner).__module__ == LearnerConfig.__module__
    return nullcontext() if built_in else naming_errors(learner.name)


def make_learner(config: TrainConfig, env: DelayedEnv, buffer: ReplayBuffer | None) -> Learner:
    """The learner, with the replay buffer that it needs."""
    name = config.learner.name
    with own_code(config.learner):
        learner = config.learner.make(env, learning_setup(config, env.delays), buffer)
        has_actor = "actor" in learner.components()
    checks.require(
        has_actor,
        f"{name}: components",
        [*learner.components()],
        "has no actor, which evaluations load: return {'actor': self.actor, ...}",
    )
    assume(config, env, learner.components()["actor"])
    return learner


def require_delayed_talk(config: TrainConfig, env: DelayedEnv, learner: Learner) -> None:
    """Refuse an actor by which UAVs read at once in each other's rows what these know late or
    never."""
    own = config.observation.own and env.delays.obs.late
    links = config.links.kind
    if config.learner.talks or not (own or links != "server"):
        return
    known = "observation.own=true" if own else f"links={links}"
    should = (
        f"has an actor that reads other UAVs' rows, which with {known} hold what each knows at "
        "once: attend over blocks of a UAV's own row (docs/extending.md), or give "
        "learner.talks=true to let UAVs talk so"
    )
    with own_code(config.learner):
        talk = undelayed_talk(learner.actor, env)
    checks.require(not talk, "learner", config.learner.name, should)


def replay_buffer(config: TrainConfig, env: DelayedEnv) -> ReplayBuffer | None:
    """The replay buffer of the learner, if it needs one; with ``backupdate``, late messages correct
    it."""
    setup = learning_setup(config, env.delays)
    with own_code(config.learner):
        size = config.learner.buffer_size(setup)
    if size is None:
        return None
    if not setup.backupdate:
        return ReplayBuffer(storage=TimeStorage(size, device=config.device))
    least = setup.least_buffer
    checks.require(
        size >= least,
        f"{config.learner.name}: buffer_size",
        size,
        f"is too little for back-updating, which needs {least}: a period and twice the longest "
        "delay",
    )
    storage = corrected_storage(config, env, config.corrected, size, setup.worlds)
    return ReplayBuffer(storage=storage)


def corrected_storage(
    config: TrainConfig, env: DelayedEnv, corrected: Collection[str], size: int, worlds: int
) -> BackupdateStorage:
    """A storage for ``size`` steps over all ``worlds``, in which late messages and rewards correct
    steps."""
    late_messages = env.delays.obs.late
    corrected = corrected if late_messages else ["reward"]
    corrections = corrections_of(env.transform, [CORRECTED[name] for name in corrected])
    # With this order the server may hold an older message than it had before, and a UAV in flight
    # sends none. The storage then has to keep the newest one.
    hindsight = "hindsight" in config.learner.reads or (
        late_messages and config.delay.order == "arrival"
    )
    return BackupdateStorage(
        size + sum(correction.lookback for correction in corrections) * worlds,
        server_recompute(env.server, corrected) if late_messages else None,
        env.delays.longest,
        corrections=corrections,
        hindsight_key=keys.HINDSIGHT if hindsight else None,
        device=config.device,
    )


def hindsight_returns(config: TrainConfig, env: DelayedEnv) -> HindsightReturns | None:
    """The returns of the learning curve; None if they are those perceived."""
    if not measures_hindsight(env.delays):
        return None
    worlds = min(config.worlds, HindsightReturns.WORLDS)
    period = learning_setup(config, env.delays).longest_period
    size = (period + 2 * env.delays.longest) * worlds
    return HindsightReturns(corrected_storage(config, env, ["reward"], size, worlds), worlds)


def make_collector(
    env: TransformedEnv, actor: torch.nn.Module, frames: int, compile: bool = False
) -> Collector:
    """An endless collector of batches of ``frames`` environment steps; ``compile``: with a compiled
    actor."""
    add_recurrent_state(env, actor)
    return Collector(
        env,
        actor,
        frames_per_batch=frames,
        total_frames=-1,
        auto_register_policy_transforms=True,
        compile_policy={"options": COMPILE_OPTIONS} if compile else None,
    )


def ticks(collector: Collector, clock: SystemClock, server: Server) -> Iterator[TensorDictBase]:
    """Batches [B, T], each collected between two ticks of the system clock (paper, section 3.6)."""
    parts: list[TensorDictBase] = []
    for part in collector:
        parts.append(part)
        if sum(part.shape[1] for part in parts) < clock.period:
            continue
        batch = torch.cat(parts, 1) if len(parts) > 1 else part  # type: ignore[arg-type]
        if clock.change:
            clock.tick(spotting(batch, server))
        parts = []
        yield batch


def read_by(config: TrainConfig, delays: ScenarioDelays, batch: TensorDictBase) -> TensorDictBase:
    """The entries of a batch [B, T] for the learner, whose replay buffer would keep messages in
    vain."""
    if backupdates(config, delays) or "message" in config.learner.reads:
        return batch
    sent = (
        keys.MESSAGE,
        keys.MESSAGE_SENT,
        keys.RECEIVED,
        keys.DELAY,
        keys.REWARD_DELAY,
        keys.EARNED_REWARD,
    )
    return batch.exclude(*sent, *map(keys.next_key, sent))


def spotting(batch: TensorDictBase, server: Server) -> torch.Tensor:
    """Which UAVs spot the source at the end of a batch [B, T], by what the server holds, [B, N]
    bool."""
    after = cast(TensorDictBase, batch["next"][:, -1])
    return server.messages(after.get(keys.RECEIVED, after[keys.MESSAGE])).spotted
