"""When an episode ends, and whether it was a success, as far as the server knows (paper, section 4.1)."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from damian.common import checks
from damian.world.messages import Messages


@dataclass
class EpisodeConfig:
    """When an episode ends (paper, section 4.1). With every end switched off the task is persistent."""

    max_steps: int | None = 50
    """Time limit [steps]; none if not given."""
    since_detection: bool = False
    """Count the limit from the latest detection instead of from the start."""
    success_share: float | None = None
    """Share of the UAVs that must spot at once for success; no success if not given."""
    discharged_share: float | None = None
    """Share of empty UAVs that ends the episode; never if not given."""
    end_with_source: bool = False
    """End when the source has finished its walk."""

    def __post_init__(self) -> None:
        if self.max_steps is not None:
            checks.in_range("episode.max_steps", self.max_steps, 1)
        for name in ("success_share", "discharged_share"):
            value = getattr(self, name)
            if value is not None:
                checks.above(f"episode.{name}", value, 0.0)
                checks.in_range(f"episode.{name}", value, 0.0, 1.0)


class Status(NamedTuple):
    """How the task stands, each [*] bool."""

    success: Tensor
    terminated: Tensor
    truncated: Tensor

    def entries(self) -> dict[str, Tensor]:
        """As TorchRL shows it, with ``done``, each [*, 1]."""
        done = self.terminated | self.truncated
        flags = {"success": self.success, "done": done}
        flags |= {"terminated": self.terminated, "truncated": self.truncated}
        return {name: flag.unsqueeze(-1) for name, flag in flags.items()}


def status(
    messages: Messages,
    steps: Tensor,
    now: Tensor,
    source_over: Tensor,
    dt: float,
    config: EpisodeConfig,
) -> Status:
    """Does the episode end, and how, as far as the server knows (paper, section 4.1).

    Time limits truncate, all else terminates; a success at the last step is a success.

    Args:
        messages: held by the server, [*, N].
        steps: elapsed steps, [*].
        now: time [s], [*].
        source_over: has the source finished its walk, [*].
        dt: length of a step [s].
        config: which ends count.
    """
    n_agents = messages.spotted.shape[-1]
    no = torch.zeros_like(source_over)
    success = over = late = no
    if config.success_share is not None:
        success = messages.spotted.sum(-1) >= share_of(config.success_share, n_agents)
    if config.discharged_share is not None:
        over = (messages.battery <= 0).sum(-1) >= share_of(config.discharged_share, n_agents)
    if config.end_with_source:
        over = over | source_over
    if config.max_steps is not None:
        waited = steps
        if config.since_detection:
            waited = (now - messages.detected_time.amax(-1).clamp(min=0)) / dt
        late = waited >= config.max_steps - 1e-3
    return Status(success, success | over, late & ~(success | over))


def share_of(share: float, n_agents: int) -> int:
    """The least number of UAVs that is at least a share of them, and at least one."""
    return max(1, math.ceil(share * n_agents - 1e-9))
