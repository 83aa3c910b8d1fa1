"""The environment of a training, and its batches: each lies between two ticks of the system clock."""

import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import cast

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from damian import keys
from damian.envs.delayed_env import DelayedEnv
from damian.envs.nodes import EpisodeTotals
from damian.envs.pipeline import make_env
from damian.learners.networks import COMPILE_OPTIONS
from damian.learners.recurrent import add_recurrent_state
from damian.learners.schedule import SystemClock
from damian.server.server import Server

from ..config import TrainConfig
from .settings import backupdates, measures_hindsight


def learning_env(config: TrainConfig) -> DelayedEnv:
    """The environment of the training, [B], with what the learner and the logs need."""
    triggered = config.clock.trigger is not None
    messages = backupdates(config) or measures_hindsight(config) or triggered
    privileged = config.critic == "privileged"
    reads = set(config.learner.reads) - {"hindsight"}  # the storage adds it
    warn_of_memory(config)
    extras = {"reward_terms", *["message"] * messages, *["privileged"] * privileged, *reads}
    env = make_env(config.train_scenario, config.worlds, config.seed, config.device, extras)
    if config.compiles:
        env.compile()
    env.append_transform(EpisodeTotals())
    return env


def warn_of_memory(config: TrainConfig) -> None:
    """Say on one line if the steps of a batch alone take more memory than there is; small ones never do."""
    steps = config.worlds * config.update_steps
    if steps * config.agents < 10**8 or config.device != "cpu" or not hasattr(os, "sysconf"):
        return
    region = replace(config.region, pool=1, initial_conditions=1)
    one = make_env(replace(config.train_scenario, region=region), 1)
    needed, there = (
        one.fake_tensordict().bytes() * steps,
        os.sysconf("SC_PAGESIZE") * os.sysconf("SC_PHYS_PAGES"),
    )
    if needed > there:
        what = (
            f"the steps of {config.worlds} worlds of {config.agents} UAVs take at least {needed / 1e9:.0f} GB"
        )
        print(f"worlds: {what}, and this machine has {there / 1e9:.0f} GB: choose fewer", file=sys.stderr)


def make_collector(
    env: TransformedEnv, actor: torch.nn.Module, frames: int, compile: bool = False
) -> Collector:
    """An endless collector of batches of ``frames`` environment steps; ``compile``: with a compiled actor."""
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
        batch = cast(TensorDictBase, torch.cat(parts, 1)) if len(parts) > 1 else part  # type: ignore[arg-type]
        if clock.change:
            clock.tick(spotting(batch, server))
        parts = []
        yield batch


def read_by(config: TrainConfig, batch: TensorDictBase) -> TensorDictBase:
    """The entries of a batch [B, T] for the learner, whose replay buffer would keep messages in vain."""
    if backupdates(config) or "message" in config.learner.reads:
        return batch
    sent = (keys.MESSAGE, keys.MESSAGE_SENT, keys.RECEIVED, keys.DELAY, keys.REWARD_DELAY, keys.EARNED_REWARD)
    return batch.exclude(*sent, *map(keys.next_key, sent))


def spotting(batch: TensorDictBase, server: Server) -> torch.Tensor:
    """Which UAVs spot the source at the end of a batch [B, T], by what the server holds, [B, N] bool."""
    after = cast(TensorDictBase, batch["next"][:, -1])
    return server.messages(after.get(keys.RECEIVED, after[keys.MESSAGE])).spotted
