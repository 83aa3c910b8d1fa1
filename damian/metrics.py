"""What is measured of episodes, while training and in an evaluation."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type


@dataclass(frozen=True)
class Evaluation:
    """Means over episodes; one that nothing ends counts the horizon as its steps."""

    episodes: int
    success_rate: float
    steps: float
    episode_return: float
    """Sum of rewards of an episode, mean over the UAVs."""


@torch.no_grad()
def evaluate(env: EnvBase, policy: nn.Module, horizon: int, sample: bool = True) -> Evaluation:
    """Fly one episode in every world, for at most ``horizon`` steps.

    Args:
        env: batch [B], with the keys of ``UavEnv``.
        policy: what chooses.
        horizon: steps after which an episode without an end is cut.
        sample: draw from the policy; else take its mode.
    """
    mode = ExplorationType.RANDOM if sample else ExplorationType.DETERMINISTIC
    with set_exploration_type(mode):
        flown = env.rollout(horizon, policy, break_when_any_done=False)
    done = flown["next", "done"].squeeze(-1)
    first = done.int().cumsum(-1) - done.int() == 0  # up to and including the first end
    rewards = flown["next", "agents", "reward"].squeeze(-1).mean(-1)
    success = (flown["next", "success"].squeeze(-1) & first).any(-1)
    return Evaluation(
        episodes=len(first),
        success_rate=success.float().mean().item(),
        steps=first.sum(-1).float().mean().item(),
        episode_return=(rewards * first).sum(-1).mean().item(),
    )


class EpisodeLog:
    """Ended episodes of the training batches; means over the latest ``window`` of them."""

    def __init__(self, window: int = 200) -> None:
        self.finished = 0
        self._recent: deque[tuple[float, float, float]] = deque(maxlen=window)

    def add(self, batch: TensorDictBase) -> None:
        """Take the episodes that end in a batch [B, T] with ``RewardSum`` and ``StepCounter``."""
        done = batch["next", "done"].squeeze(-1)

        def ended(*key: str) -> Tensor:
            return cast(Tensor, batch["next", *key])[done].float().flatten(1).mean(1)

        keys = (("agents", "episode_reward"), ("success",), ("step_count",))
        rows = torch.stack([ended(*key) for key in keys], -1).tolist()
        self._recent.extend(map(tuple, rows))
        self.finished += len(rows)

    def state_dict(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"finished": self.finished, "recent": [list(row) for row in self._recent]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """From a checkpoint."""
        self.finished = int(state["finished"])
        self._recent.extend(tuple(row) for row in state["recent"])

    def means(self) -> dict[str, float]:
        """Episode return, success rate and steps; nan before the first end."""
        names = ("episode_return", "success_rate", "steps")
        if not self._recent:
            return dict.fromkeys(names, math.nan)
        columns = zip(*self._recent, strict=True)
        return {n: sum(c) / len(self._recent) for n, c in zip(names, columns, strict=True)}
