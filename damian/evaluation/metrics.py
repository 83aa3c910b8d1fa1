"""What is measured of episodes, while training and in an evaluation."""

import math
from dataclasses import dataclass
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian.envs.delayed_env import DelayedEnv
from damian.learners.recurrent import prime
from damian.server.features import Snapshot
from damian.server.server import Server


@dataclass(frozen=True)
class Evaluation:
    """Means over episodes, as the server saw them and (``true_``) as one would have that hears at once."""

    episodes: int
    success_rate: float
    steps: float
    """Of an episode; where success is possible, one without it counts the horizon."""
    episode_return: float
    """Sum of rewards of an episode, mean over the UAVs."""
    true_success_rate: float
    """Some time, all the UAVs that it takes really spotted at once."""
    true_steps: float
    """Until then; without it, the horizon."""
    true_return: float
    """Likewise until then."""
    age: float
    """Of what the server knows of a UAV [steps]."""
    late: float
    """Share of the messages."""
    lost: float
    """Share of the messages."""


@torch.no_grad()
def evaluate(env: DelayedEnv, policy: nn.Module, horizon: int, sample: bool = True) -> Evaluation:
    """Fly one episode in every world, for at most ``horizon`` steps.

    Args:
        env: batch [B], with ``message`` among its extras.
        policy: what chooses.
        horizon: steps after which an episode without an end is cut.
        sample: draw from the policy; else take its mode.
    """
    prime(env, policy)
    mode = ExplorationType.RANDOM if sample else ExplorationType.DETERMINISTIC
    with set_exploration_type(mode):
        flown = env.rollout(horizon, policy, break_when_any_done=False)
    return evaluation(flown, env.worlds.server)


def evaluation(flown: TensorDictBase, server: Server) -> Evaluation:
    """What the first episode of each world in a flight [B, T] comes to."""
    horizon, after = flown.shape[1], cast(TensorDictBase, flown["next"])
    elapsed = torch.arange(1, horizon + 1, device=flown.device).expand(flown.shape)
    message = after["agents", "message"]
    truth = server.serve(Snapshot.unpack(message), elapsed, after.get("source_over", None))
    told = _until(after["done"].squeeze(-1))
    true = told & _until(truth.status.terminated)
    success, won = _ever(after["success"].squeeze(-1), told), _ever(truth.status.success, true)
    can_fail = server.config.episode.success_share is not None
    steps, won_at = (
        torch.where(ever | (not can_fail), until.sum(-1), horizon)
        for ever, until in ((success, told), (won, true))
    )
    held = Snapshot.unpack(after.get(("agents", "received"), message))
    age = elapsed.unsqueeze(-1) - held.time / server.dt
    late, lost = _late(cast(TensorDictBase, after["agents"]), told)
    return Evaluation(
        episodes=len(told),
        success_rate=_mean(success),
        steps=_mean(steps),
        episode_return=_mean((after["agents", "reward"].squeeze(-1).mean(-1) * told).sum(-1)),
        true_success_rate=_mean(won),
        true_steps=_mean(won_at),
        true_return=_mean((truth.reward.mean(-1) * true).sum(-1)),
        age=_mean(age[told]),
        late=late,
        lost=lost,
    )


def _until(ended: Tensor) -> Tensor:
    """Up to and including the first end, [B, T] bool."""
    return ended.int().cumsum(-1) - ended.int() == 0


def _ever(flag: Tensor, among: Tensor) -> Tensor:
    return (flag & among).any(-1)


def _late(agents: TensorDictBase, counts: Tensor) -> tuple[float, float]:
    """Shares of the messages sent in the steps [B, T] that count: late ones, and lost ones."""
    sent = cast(Tensor, agents["talks"])[counts]
    if "delay" not in agents or not sent.any():
        return 0.0, 0.0
    delay = cast(Tensor, agents["delay"]).squeeze(-1)[counts][sent]
    return _mean(delay > 0), _mean(delay < 0)


def _mean(numbers: Tensor) -> float:
    return numbers.float().mean().item()


class EpisodeLog:
    """Ended episodes of the training batches, as exponential means over them.

    Args:
        factor: weight of what was before; 0.991 is what the paper's Figures 5 and 6 are smoothed with.
    """

    NAMES = ("episode_return", "success_rate", "steps")

    def __init__(self, factor: float = 0.991) -> None:
        self.factor, self.finished = factor, 0
        self._weight, self._sums = 0.0, [0.0] * len(self.NAMES)

    def add(self, batch: TensorDictBase) -> None:
        """Take the episodes that end in a batch [B, T] with ``RewardSum`` and ``StepCounter``."""
        by_time = cast(TensorDictBase, batch["next"]).transpose(0, 1)
        done = by_time["done"].squeeze(-1)
        keys = (("agents", "episode_reward"), "success", "step_count")
        ended = [cast(Tensor, by_time[key])[done].float().flatten(1).mean(1) for key in keys]
        for row in torch.stack(ended, -1).tolist():
            self._weight = self.factor * self._weight + 1
            self._sums = [self.factor * old + new for old, new in zip(self._sums, row, strict=True)]
            self.finished += 1

    def state_dict(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"finished": self.finished, "weight": self._weight, "sums": list(self._sums)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """From a checkpoint."""
        self.finished, self._weight = int(state["finished"]), float(state["weight"])
        self._sums = [float(total) for total in state["sums"]]

    def means(self) -> dict[str, float]:
        """Episode return, success rate and steps; nan before the first end."""
        if not self.finished:
            return dict.fromkeys(self.NAMES, math.nan)
        return {name: total / self._weight for name, total in zip(self.NAMES, self._sums, strict=True)}
