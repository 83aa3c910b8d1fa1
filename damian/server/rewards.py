"""Features turned into named reward terms (eq. 5-8), and the end of an episode.

``reward`` and ``status`` are pure and batched, as ``observe`` is. A term's name is its feature, its
weight's key and its tag in the logs.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from damian.common import checks
from damian.server.features import Snapshot

INDIVIDUAL = ("coverage", "spotted", "battery")
SYSTEM = (
    "source_distance",
    "source_time",
    "source_bearing",
    "source_drift",
    "spotting_agents",
    "mean_distance",
    "mean_distance_not_spotting",
    "mean_distance_spotting",
)


@dataclass
class RewardConfig:
    """A task: weights of the reward terms. A term with weight 0 is not computed."""

    coverage: float = 0.0
    """w_ca of R1^a (eq. 7)."""
    spotted: float = 1.0
    """w_k of R2^a (eq. 7), divided by the motions that it took."""
    battery: float = 0.0
    """w_b of R3^a (eq. 7)."""
    source_distance: float = 0.0
    """w_ds of R1^s (eq. 6), divided by the motions since the UAV spotted."""
    source_time: float = 0.0
    """w_ts of R2^s (eq. 6)."""
    source_bearing: float = 0.0
    """w_bs of R3^s (eq. 6)."""
    source_drift: float = 0.0
    """w_th of R4^s (eq. 6)."""
    spotting_agents: float = 0.0
    """w_ss of R5^s (eq. 6)."""
    mean_distance: float = 0.0
    """w_avg of R6^s (eq. 6)."""
    mean_distance_not_spotting: float = 0.0
    """w_nss of R7^s (eq. 6)."""
    mean_distance_spotting: float = 0.0
    """w_ss of R8^s (eq. 6)."""
    individual: float = 1.0
    """w_a (eq. 8)."""
    system: float = 1.0
    """w_s (eq. 8)."""
    drift: str = "smooth"
    """``smooth``: 1 - |2 theta - 1|; ``printed``: 2 theta up to 1/2, then 1 - theta (as in eq. 6)."""
    desired_spotting: float = 1.0
    """M_ss of R5^s: desired share of spotting UAVs."""
    desired_distance: float = 0.5
    """D of R6^s, as a share of the region's largest vertex distance."""
    desired_distance_not_spotting: float = 0.5
    """D_nss of R7^s, likewise."""
    desired_distance_spotting: float = 0.1
    """D_ss of R8^s, likewise."""
    bonus: float = 0.0
    """Added on success."""
    bonus_over_steps: bool = False
    """Divide the bonus by the steps that the success took (use case 2: 2 / steps)."""
    penalty: float = 0.0
    """Subtracted when an episode ends without success."""

    def __post_init__(self) -> None:
        for name in (*INDIVIDUAL, *SYSTEM, "individual", "system", "bonus", "penalty"):
            value = getattr(self, name)
            checks.require(math.isfinite(value), f"task.{name}", value, "is not a finite weight")
        checks.one_of("task.drift", self.drift, ["smooth", "printed"])
        checks.in_range("task.desired_spotting", self.desired_spotting, 0.0, 1.0)

    @property
    def terms(self) -> list[str]:
        """Names of the terms that count."""
        individual = [n for n in INDIVIDUAL if getattr(self, n) * self.individual != 0]
        return individual + [n for n in SYSTEM if getattr(self, n) * self.system != 0]

    def weight(self, name: str) -> float:
        """The weight of a term in the total (eq. 8)."""
        group = self.individual if name in INDIVIDUAL else self.system
        return getattr(self, name) * group


@dataclass
class EpisodeConfig:
    """When an episode ends (SPEC 5). With every end switched off the task is persistent."""

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


class Counters(NamedTuple):
    """What reward and status need besides the features."""

    steps: Tensor
    """Elapsed steps of the episode, [*]."""
    motions: Tensor
    """Motions since each UAV last spotted, [*, N]."""


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


def reward(features: dict[str, Tensor], counters: Counters, config: RewardConfig) -> dict[str, Tensor]:
    """Weighted reward terms by name (eq. 6 and 7); their sum is the reward (eq. 8).

    Args:
        features: as ``observe`` returns them, each [*, N].
        counters: [*] and [*, N].
        config: weights.

    Returns:
        Each term with a weight, [*, N].
    """
    return {
        name: config.weight(name) * _TERMS[name](features[name], counters, config) for name in config.terms
    }


def status(
    snapshot: Snapshot,
    steps: Tensor,
    now: Tensor,
    source_over: Tensor,
    dt: float,
    config: EpisodeConfig,
) -> Status:
    """Does the episode end, and how, as far as the server knows (SPEC 5).

    Time limits truncate, all else terminates; a success at the last step is a success.

    Args:
        snapshot: messages held by the server, [*, N].
        steps: elapsed steps, [*].
        now: time [s], [*].
        source_over: has the source finished its walk, [*].
        dt: length of a step [s].
        config: which ends count.
    """
    n_agents = snapshot.spotted.shape[-1]
    no = torch.zeros_like(source_over)
    success = over = late = no
    if config.success_share is not None:
        success = snapshot.spotted.sum(-1) >= share_of(config.success_share, n_agents)
    if config.discharged_share is not None:
        over = (snapshot.battery <= 0).sum(-1) >= share_of(config.discharged_share, n_agents)
    if config.end_with_source:
        over = over | source_over
    if config.max_steps is not None:
        waited = steps
        if config.since_detection:
            waited = (now - snapshot.detected_time.amax(-1).clamp(min=0)) / dt
        late = waited >= config.max_steps - 1e-3
    return Status(success, success | over, late & ~(success | over))


def final_reward(ended: Status, counters: Counters, config: RewardConfig) -> Tensor:
    """Bonus on success, penalty at any other end, the same for every UAV, [*]."""
    bonus = config.bonus / counters.steps.clamp(min=1) if config.bonus_over_steps else config.bonus
    failure = (ended.terminated | ended.truncated) & ~ended.success
    return ended.success * bonus - failure * config.penalty


def share_of(share: float, n_agents: int) -> int:
    """The least number of UAVs that is at least a share of them, and at least one."""
    return max(1, math.ceil(share * n_agents - 1e-9))


def _per_motion(value: Tensor, counters: Counters) -> Tensor:
    return value / counters.motions.clamp(min=1)


def _drift(theta: Tensor, config: RewardConfig) -> Tensor:
    if config.drift == "printed":
        return torch.where(theta <= 0.5, 2 * theta, 1 - theta)
    return 1 - (2 * theta - 1).abs()


def _near(desired: str) -> Callable[[Tensor, Counters, RewardConfig], Tensor]:
    return lambda value, _, config: 1 - (getattr(config, desired) - value).abs()


_TERMS: dict[str, Callable[[Tensor, Counters, RewardConfig], Tensor]] = {
    "coverage": lambda value, *_: value,
    "spotted": lambda value, counters, _: _per_motion(value, counters),
    "battery": lambda value, *_: value,
    "source_distance": lambda value, counters, _: _per_motion(1 - value, counters),
    "source_time": lambda value, *_: 1 - value,
    "source_bearing": lambda value, *_: 1 - value,
    "source_drift": lambda value, _, config: _drift(value, config),
    "spotting_agents": _near("desired_spotting"),
    "mean_distance": _near("desired_distance"),
    "mean_distance_not_spotting": _near("desired_distance_not_spotting"),
    "mean_distance_spotting": _near("desired_distance_spotting"),
}
