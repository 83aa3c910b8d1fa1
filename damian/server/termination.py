"""The ends of episodes and the success of the task, as the server knows them
(paper, section 4.1)."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from damian.server.config import EpisodeConfig
from damian.world.messages import Messages


class Status(NamedTuple):
    """Status of the task, as the server knows it."""

    success: Tensor
    """Whether the task is accomplished, [*] bool."""
    terminated: Tensor
    """Whether the episode has ended by success or failure, [*] bool."""
    truncated: Tensor
    """Whether the episode has ended by its time limit, [*] bool."""

    def entries(self) -> dict[str, Tensor]:
        """TorchRL's entries ``done``, ``terminated`` and ``truncated``, and ``success``, each
        [*, 1]."""
        flags = self._asdict() | {"done": self.terminated | self.truncated}
        return {name: flag.unsqueeze(-1) for name, flag in flags.items()}


def status(
    messages: Messages, steps: Tensor, source_over: Tensor, dt: float, config: EpisodeConfig
) -> Status:
    """Success and the end of the episode: a time limit truncates, every other end terminates."""
    n_agents = messages.spotted.shape[-1]
    success = ended = timed_out = torch.zeros_like(source_over)
    if config.success_share is not None:
        success = messages.spotted.sum(-1) >= share_of(config.success_share, n_agents)
    if config.all_sources:
        success = success | messages.spots.any(-2).all(-1)
    if config.discharged_share is not None:
        ended = messages.empty.sum(-1) >= share_of(config.discharged_share, n_agents)
    if config.end_with_source:
        ended = ended | source_over
    if config.max_steps is not None:
        if config.since_detection:
            # Times in messages are float32, so the step of the latest detection is the nearest
            # whole number.
            latest = messages.detected_time.amax((-2, -1)).clamp(min=0).double()
            steps = steps - (latest / dt).round().long()
        timed_out = steps >= config.max_steps
    return Status(success, success | ended, timed_out & ~(success | ended))


def share_of(share: float, n_agents: int) -> int:
    """Least number of UAVs that is at least this share of them, and at least one."""
    return max(1, math.ceil(share * n_agents - 1e-9))
