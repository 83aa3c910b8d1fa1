"""Collects the batches that a learner learns from, one between two ticks of the system clock."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from damian import keys
from damian.learners.networks import COMPILE_OPTIONS
from damian.learners.recurrent import add_recurrent_state
from damian.learners.schedule import SystemClock
from damian.runs.training_state import CarriedStep
from damian.server.server import Server

from .settings import TrainConfig
from .workers import Workers


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


@contextmanager
def collecting(
    config: TrainConfig, env: TransformedEnv, actor: torch.nn.Module
) -> Iterator[Collector | Workers]:
    """The collector that a training's settings choose; its workers, if it has some, end with the context.

    Its batches are as long as the largest number of steps that divides every possible period of the clock.
    """
    frames = config.worlds * SystemClock(config.clock, config.update_steps).unit
    if config.collector == "sync":
        collector = make_collector(env, actor, frames, config.compile)
    else:
        collector = Workers(config, actor, frames)
        where = ", ".join(map(str, collector.process_ids))
        print(f"collector: {config.collector}, {config.workers} workers (processes {where})")
    try:
        yield collector
    finally:
        collector.shutdown()


def collector_parts(collector: Collector | Workers) -> dict[str, Any]:
    """What a checkpoint stores of a collector, by name."""
    if isinstance(collector, Workers):
        return {"workers": collector}
    return {"environment": collector.env, "collector": CarriedStep(collector)}


def ticks(collector: Collector | Workers, clock: SystemClock, server: Server) -> Iterator[TensorDictBase]:
    """Batches [B, T], each collected between two ticks of the system clock (paper, section 3.6)."""
    parts: list[TensorDictBase] = []
    for part in collector:
        parts.append(part)
        if sum(part.shape[1] for part in parts) < clock.period:
            continue
        batch = cast(TensorDictBase, torch.cat(parts, 1)) if len(parts) > 1 else part  # type: ignore[arg-type]
        if clock.change:
            clock.tick(spotting(batch, server))
        if isinstance(collector, Workers):
            collector.keep_state()
        parts = []
        yield batch


def spotting(batch: TensorDictBase, server: Server) -> torch.Tensor:
    """Which UAVs spot the source at the end of a batch [B, T], by what the server holds, [B, N] bool."""
    after = cast(TensorDictBase, batch["next"][:, -1])
    return server.messages(after.get(keys.RECEIVED, after[keys.MESSAGE])).spotted
