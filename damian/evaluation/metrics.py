"""What is measured of episodes, while training and in an evaluation."""

import math
from dataclasses import dataclass
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian import keys
from damian.envs.delayed_env import DelayedEnv
from damian.learners.recurrent import add_recurrent_state
from damian.server.server import Server
from damian.world.messages import Messages


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
        policy: chooses the actions.
        horizon: steps after which an episode without an end is cut.
        sample: draw actions from the policy; else take its mode.
    """
    add_recurrent_state(env, policy)
    mode = ExplorationType.RANDOM if sample else ExplorationType.DETERMINISTIC
    with set_exploration_type(mode):
        rollout = env.rollout(horizon, policy, break_when_any_done=False)
    return evaluation(rollout, env.server)


def evaluation(rollout: TensorDictBase, server: Server) -> Evaluation:
    """Measures of the first episode of each world in a rollout [B, T]."""
    horizon, after = rollout.shape[1], cast(TensorDictBase, rollout["next"])
    elapsed = torch.arange(1, horizon + 1, device=rollout.device).expand(rollout.shape)
    message = after[keys.MESSAGE]
    truth = server(Messages.unpack(message), elapsed, after.get(keys.SOURCE_OVER, None))
    perceived = _until(after[keys.DONE].squeeze(-1))
    true = perceived & _until(truth.status.terminated)
    success, true_success = (
        _ever(after[keys.SUCCESS].squeeze(-1), perceived),
        _ever(truth.status.success, true),
    )
    can_succeed = server.episode.success_share is not None
    steps, true_steps = (
        torch.where(ever | (not can_succeed), until.sum(-1), horizon)
        for ever, until in ((success, perceived), (true_success, true))
    )
    held = Messages.unpack(after.get(keys.RECEIVED, message))
    age = held.age(elapsed * server.dt) / server.dt
    late, lost = _message_shares(after, perceived)
    return Evaluation(
        episodes=len(perceived),
        success_rate=_mean(success),
        steps=_mean(steps),
        episode_return=_mean((after[keys.REWARD].squeeze(-1).mean(-1) * perceived).sum(-1)),
        true_success_rate=_mean(true_success),
        true_steps=_mean(true_steps),
        true_return=_mean((truth.reward.mean(-1) * true).sum(-1)),
        age=_mean(age[perceived]),
        late=late,
        lost=lost,
    )


def _until(ended: Tensor) -> Tensor:
    """Up to and including the first end, [B, T] bool."""
    return ended.int().cumsum(-1) - ended.int() == 0


def _ever(flag: Tensor, among: Tensor) -> Tensor:
    return (flag & among).any(-1)


def _message_shares(after: TensorDictBase, counted: Tensor) -> tuple[float, float]:
    """Shares of late and of lost ones among the messages sent in the counted steps [B, T]."""
    sent = cast(Tensor, after[keys.MESSAGE_SENT])[counted]
    delay = after.get(keys.DELAY, None)
    if delay is None or not sent.any():
        return 0.0, 0.0
    delay = delay.squeeze(-1)[counted][sent]
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
        done = by_time[keys.DONE].squeeze(-1)
        measured = (keys.EPISODE_REWARD, keys.SUCCESS, keys.STEP_COUNT)
        ended = [cast(Tensor, by_time[key])[done].float().flatten(1).mean(1) for key in measured]
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
