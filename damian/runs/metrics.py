"""Measures of episodes, in training and in evaluations."""

import math
from dataclasses import astuple, dataclass, fields
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian import keys
from damian.envs.delayed_env import DelayedEnv
from damian.keys import next_key
from damian.learners.recurrent import add_recurrent_state
from damian.replay.recompute import beliefs_in_hindsight
from damian.server.features import FEATURES
from damian.server.rewards import features_read
from damian.server.server import Server


@dataclass(frozen=True)
class Evaluation:
    """Means over episodes: from messages without delay and, ``perceived_``, as the server perceived them."""

    episodes: int
    """Number of episodes."""
    success_rate: float
    """Share of the episodes in which as many UAVs as required spotted the source at the same time."""
    steps: float
    """Length of an episode; where success is possible, an episode without it counts the horizon."""
    return_: float
    """Sum of the undelayed rewards of an episode, as a mean over the UAVs."""
    perceived_success_rate: float
    """Share of the episodes that ended with success as far as the server knew."""
    perceived_steps: float
    """Length of an episode up to the end that the server perceived, counted as ``steps``."""
    perceived_return: float
    """Sum of the rewards as they were paid, as a mean over the UAVs."""
    age: float
    """Age of information: age of the message of a UAV that the server holds [steps]."""
    late: float
    """Share of the messages that arrive late."""
    lost: float
    """Share of the messages that never arrive."""

    def row(self, group: str = "") -> dict[str, float]:
        """The measures by the names that they have in every file; ``return`` is no name for a field."""
        return dict(zip([group + name for name in EVALUATED], astuple(self), strict=True))


EVALUATED = tuple(field.name.rstrip("_") for field in fields(Evaluation))
"""Names of the measures of an ``Evaluation`` in files."""


@torch.no_grad()
def evaluate(env: DelayedEnv, policy: nn.Module, horizon: int, sample: bool = True) -> Evaluation:
    """Fly one episode of at most ``horizon`` steps in every world of an environment with ``message``.

    With ``sample``, actions are drawn from the policy's distribution, else the most likely ones are taken.
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
    over, belief = next_step.get(keys.SOURCE_OVER, None), _true_belief(rollout, server, elapsed)
    truth = server(server.messages(message), elapsed, over, belief=belief)
    in_episode = _up_to_first_end(next_step[keys.DONE].squeeze(-1))
    in_true_episode = in_episode & _up_to_first_end(truth.status.terminated)
    success, true_success = (
        _ever(next_step[keys.SUCCESS].squeeze(-1), in_episode),
        _ever(truth.status.success, in_true_episode),
    )
    can_succeed = server.episode.success_share is not None
    perceived_steps, steps = (
        torch.where(succeeded | (not can_succeed), counted.sum(-1), horizon)
        for succeeded, counted in ((success, in_episode), (true_success, in_true_episode))
    )
    held = server.messages(next_step.get(keys.RECEIVED, message))
    age = held.age(elapsed * server.dt) / server.dt
    late, lost = _message_shares(next_step, in_episode)
    return Evaluation(
        episodes=len(in_episode),
        success_rate=_mean(true_success),
        steps=_mean(steps),
        return_=_mean((truth.reward.mean(-1) * in_true_episode).sum(-1)),
        perceived_success_rate=_mean(success),
        perceived_steps=_mean(perceived_steps),
        perceived_return=_mean((next_step[keys.REWARD].squeeze(-1).mean(-1) * in_episode).sum(-1)),
        age=_mean(age[in_episode]),
        late=late,
        lost=lost,
    )


def _true_belief(rollout: TensorDictBase, server: Server, elapsed: Tensor) -> Tensor | None:
    """The belief from undelayed messages in first episodes, [B, T, K]; None if no reward term reads it."""
    if not any(FEATURES.get(name, "feature").scope == "belief" for name in features_read(server.reward)):
        return None
    steps = rollout.select(keys.MESSAGE, keys.BELIEF, next_key(keys.MESSAGE), next_key(keys.BELIEF))
    sent = cast(Tensor, rollout[next_key(keys.MESSAGE_SENT)])
    steps[next_key(keys.DELAY)] = sent.long().unsqueeze(-1) - 1  # 0, or -1 where none was sent
    steps[keys.STEP_COUNT] = elapsed.unsqueeze(-1) - 1
    return beliefs_in_hindsight(server, steps.transpose(0, 1)).transpose(0, 1)


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
    """Means over the latest episodes of the training, as many of each world, at least ``EPISODES`` in all.

    Every world counts the same, and nothing is known before one has ended in each: the first episodes to end
    are the shortest, and their means would be too good.
    """

    NAMES = ("perceived_return", "perceived_success_rate", "perceived_steps")
    EPISODES = 100

    def __init__(self, worlds: int) -> None:
        self.finished = 0
        self._latest = torch.full((worlds, math.ceil(self.EPISODES / worlds), len(self.NAMES)), torch.nan)

    def add(self, batch: TensorDictBase) -> None:
        """Add the episodes that end in a batch [B, T], with the entries of ``EpisodeTotals``."""
        steps, kept = cast(TensorDictBase, batch["next"]), self._latest.shape[1]
        done = steps[keys.DONE].to("cpu")
        totals = [steps[key].flatten(2).float().mean(2) for key in _TOTALS]
        ended = torch.stack(totals, -1).to("cpu").masked_fill(~done, torch.nan)  # [B, T, 3]
        known = torch.cat([self._latest, ended], 1)
        when = torch.arange(known.shape[1]).where(~known[..., 0].isnan(), -1)
        latest = when.topk(kept, 1).indices.unsqueeze(-1).expand(-1, -1, len(self.NAMES))
        self._latest, self.finished = known.gather(1, latest), self.finished + int(done.sum())

    def state_dict(self) -> dict[str, Any]:
        return {"finished": self.finished, "latest": self._latest}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.finished, self._latest = int(state["finished"]), state["latest"]

    def means(self) -> dict[str, float]:
        """Mean return, success rate and steps as perceived; nan before an episode has ended in each world."""
        return dict(zip(self.NAMES, self._latest.nanmean(1).mean(0).tolist(), strict=True))


_TOTALS = (keys.EPISODE_REWARD, keys.SUCCESS, keys.STEP_COUNT)
"""Entries of a last step with the measures of the episode, in the order of ``EpisodeLog.NAMES``."""
