"""Measures of episodes, in training and in evaluations."""

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
from damian.replay.recompute import beliefs_in_hindsight
from damian.server.belief import first_belief, report_rows
from damian.server.server import Server


@dataclass(frozen=True)
class Evaluation:
    """Means over episodes: as the server perceived them and (``true_``) from messages without delay."""

    episodes: int
    """Number of episodes."""
    success_rate: float
    """Share of the episodes that ended with success."""
    steps: float
    """Length of an episode; where success is possible, an episode without it counts the horizon."""
    episode_return: float
    """Sum of the rewards of an episode, as a mean over the UAVs."""
    true_success_rate: float
    """Share of the episodes in which as many UAVs as required truly spotted the source at the same time."""
    true_steps: float
    """Length of an episode up to its true end, counted as ``steps``."""
    true_return: float
    """Sum of the undelayed rewards up to the true end, as a mean over the UAVs."""
    age: float
    """Age of information: age of the message of a UAV that the server holds [steps]."""
    late: float
    """Share of the messages that arrive late."""
    lost: float
    """Share of the messages that never arrive."""


@torch.no_grad()
def evaluate(env: DelayedEnv, policy: nn.Module, horizon: int, sample: bool = True) -> Evaluation:
    """Fly one episode in every world, for at most ``horizon`` steps.

    Args:
        env: environment of B worlds, with ``message`` among its extras.
        policy: chooses the actions.
        horizon: number of steps after which an episode that has not ended is cut.
        sample: whether to draw actions from the policy's distribution; else its mode is taken.
    """
    add_recurrent_state(env, policy)
    mode = ExplorationType.RANDOM if sample else ExplorationType.DETERMINISTIC
    with set_exploration_type(mode):
        rollout = env.rollout(horizon, policy, break_when_any_done=False)
    return evaluation(rollout, env.server)


def evaluation(rollout: TensorDictBase, server: Server) -> Evaluation:
    """Measures of the first episode of each world in a rollout [B, T]."""
    horizon, next_step = rollout.shape[1], cast(TensorDictBase, rollout["next"])
    elapsed = torch.arange(1, horizon + 1, device=rollout.device).expand(rollout.shape)
    message = next_step[keys.MESSAGE]
    over, belief = next_step.get(keys.SOURCE_OVER, None), _true_belief(rollout, server)
    truth = server(server.messages(message), elapsed, over, belief=belief)
    in_episode = _up_to_first_end(next_step[keys.DONE].squeeze(-1))
    in_true_episode = in_episode & _up_to_first_end(truth.status.terminated)
    success, true_success = (
        _ever(next_step[keys.SUCCESS].squeeze(-1), in_episode),
        _ever(truth.status.success, in_true_episode),
    )
    can_succeed = server.episode.success_share is not None
    steps, true_steps = (
        torch.where(succeeded | (not can_succeed), counted.sum(-1), horizon)
        for succeeded, counted in ((success, in_episode), (true_success, in_true_episode))
    )
    held = server.messages(next_step.get(keys.RECEIVED, message))
    age = held.age(elapsed * server.dt) / server.dt
    late, lost = _message_shares(next_step, in_episode)
    return Evaluation(
        episodes=len(in_episode),
        success_rate=_mean(success),
        steps=_mean(steps),
        episode_return=_mean((next_step[keys.REWARD].squeeze(-1).mean(-1) * in_episode).sum(-1)),
        true_success_rate=_mean(true_success),
        true_steps=_mean(true_steps),
        true_return=_mean((truth.reward.mean(-1) * in_true_episode).sum(-1)),
        age=_mean(age[in_episode]),
        late=late,
        lost=lost,
    )


def _true_belief(rollout: TensorDictBase, server: Server) -> Tensor | None:
    """The belief after each step of a rollout [B, T], had no message been late or lost, [B, T, K].

    None if no reward can depend on it: only terms of one's own read the belief.
    """
    if server.grid is None or not server.reward.custom_terms:
        return None
    by_step = cast(TensorDictBase, rollout.transpose(0, 1).select(keys.MESSAGE, "next"))
    steps = by_step.clone(False)
    first, done = server.messages(steps[keys.MESSAGE]), steps["next", keys.DONE]
    rows = report_rows(server.grid, first, torch.ones_like(first.spotted))
    steps[keys.BELIEF] = first_belief(server.grid, rows, server.region_of(first))
    begins = torch.cat([torch.ones_like(done[:1]), done[:-1]])
    steps[keys.STEP_COUNT] = (~begins).long()  # 0 where an episode begins, as ``beliefs_in_hindsight`` reads
    steps["next", keys.DELAY] = steps["next", keys.MESSAGE_SENT].long().unsqueeze(-1) - 1  # 0: on time
    return beliefs_in_hindsight(server, steps).transpose(0, 1)


def _up_to_first_end(ended: Tensor) -> Tensor:
    """Mask of the steps up to and including the first end, [B, T] bool."""
    return ended.int().cumsum(-1) - ended.int() == 0


def _ever(flag: Tensor, counted: Tensor) -> Tensor:
    return (flag & counted).any(-1)


def _message_shares(next_step: TensorDictBase, counted: Tensor) -> tuple[float, float]:
    """Shares of late and of lost messages among those sent in the counted steps [B, T]."""
    sent = cast(Tensor, next_step[keys.MESSAGE_SENT])[counted]
    delay = next_step.get(keys.DELAY, None)
    if delay is None or not sent.any():
        return 0.0, 0.0
    delay = delay.squeeze(-1)[counted][sent]
    return _mean(delay > 0), _mean(delay < 0)


def _mean(numbers: Tensor) -> float:
    return numbers.float().mean().item()


class EpisodeLog:
    """Exponential means over the episodes that ended in the training batches.

    Args:
        factor: smoothing factor, by which each new episode multiplies the weight of all earlier ones; 0.991
            in the paper's Figures 5 and 6.
    """

    NAMES = ("episode_return", "success_rate", "steps")

    def __init__(self, factor: float = 0.991) -> None:
        self.factor, self.finished = factor, 0
        self._weight, self._sums = 0.0, [0.0] * len(self.NAMES)

    def add(self, batch: TensorDictBase) -> None:
        """Add the episodes that end in a batch [B, T], with ``RewardSum`` and ``StepCounter`` entries."""
        steps = cast(TensorDictBase, batch["next"]).transpose(0, 1)  # in order of time, as the mean needs
        done = steps[keys.DONE].squeeze(-1)
        measured = (keys.EPISODE_REWARD, keys.SUCCESS, keys.STEP_COUNT)
        ended = [cast(Tensor, steps[key])[done].float().flatten(1).mean(1) for key in measured]
        for row in torch.stack(ended, -1).tolist():
            self._weight = self.factor * self._weight + 1
            self._sums = [self.factor * old + new for old, new in zip(self._sums, row, strict=True)]
            self.finished += 1

    def state_dict(self) -> dict[str, Any]:
        """Return the state that a checkpoint stores."""
        return {"finished": self.finished, "weight": self._weight, "sums": list(self._sums)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state that a checkpoint has stored."""
        self.finished, self._weight = int(state["finished"]), float(state["weight"])
        self._sums = [float(total) for total in state["sums"]]

    def means(self) -> dict[str, float]:
        """Mean episode return, success rate and steps; nan before the first episode has ended."""
        if not self.finished:
            return dict.fromkeys(self.NAMES, math.nan)
        return {name: total / self._weight for name, total in zip(self.NAMES, self._sums, strict=True)}
