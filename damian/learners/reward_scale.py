"""Makes learning independent of the scale of the rewards: values and returns by their running statistics."""

from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import PopArtValueNorm, RunningValueNorm
from torchrl.objectives.value.functional import generalized_advantage_estimate

from damian import keys

FORGETTING = 0.99
"""Share of the running statistics of values that an update keeps: they reflect about the last 100 updates."""
_SMALLEST_VARIANCE = 1e-16
"""TorchRL's, 1e-5, is that of rewards which are merely small."""


class NormalizedValue(nn.Module):
    """Values from a network whose outputs are values of mean 0 and standard deviation 1 (Yu et al. 2022)."""

    def __init__(self, network: nn.Module, device: torch.device | None) -> None:
        super().__init__()
        self.network = network
        norm = PopArtValueNorm(beta=FORGETTING, epsilon=_SMALLEST_VARIANCE, device=device)
        self.norm = norm.double()  # the variance is a difference of squares

    def forward(self, observations: Tensor) -> Tensor:
        """Return the values of observations [*, N, G] in the unit of the rewards, [*, N, 1]."""
        value = self.network(observations)
        return self.norm.denormalize(value).to(value.dtype)


def update_value_scale(critic: TensorDictModule, targets: Tensor) -> None:
    """Add value targets [*, 1] to the running statistics of a critic, if it has any."""
    if isinstance(critic.module, NormalizedValue):
        critic.module.norm.update(targets.double())


def value_scale(critic: TensorDictModule) -> Tensor | float:
    """Running standard deviation of a critic's value targets, [1]; 1 if its values are not normalised."""
    return critic.module.norm.scale().float() if isinstance(critic.module, NormalizedValue) else 1.0


class ReturnScale(nn.Module):
    """Running root mean square of the discounted returns, by which to divide rewards [B, N, 1]."""

    returns: Tensor
    """Sum of the rewards of the episode so far, each discounted by the simulation steps since, [B, N, 1]."""

    def __init__(self, like: Tensor, gamma: float) -> None:
        super().__init__()
        self.gamma = gamma
        self.norm = RunningValueNorm(epsilon=_SMALLEST_VARIANCE, device=like.device)
        self.register_buffer("returns", torch.zeros_like(like))

    @property
    def value(self) -> Tensor:
        """The root mean square, [1]."""
        return torch.hypot(cast(Tensor, self.norm.mean), self.norm.scale())

    @torch.no_grad()
    def update(self, batch: TensorDictBase) -> None:
        """Add the discounted returns at every step of the next batch [B, T] of the same worlds."""
        rewards, done = (cast(Tensor, batch[keys.next_key(key)]) for key in (keys.REWARD, keys.DONE))
        # Only with ``clock.skip`` do steps have durations other than 1.
        durations = cast(Tensor, batch.get(keys.next_key(keys.DURATION), torch.ones_like(done).long()))
        gamma, done = (x.unsqueeze(-2).expand_as(rewards) for x in (self.gamma**durations, done))
        rewards = rewards.clone()
        rewards[:, 0] += gamma[:, 0] * self.returns
        begins = torch.cat([torch.ones_like(done[:, :1]), done[:, :-1]], 1)
        # With lambda 1 and values of 0, the estimate is the sum of the rewards that follow, discounted: here
        # of those before, as time is reversed.
        zero = torch.zeros_like(rewards)
        discount: Any = gamma.flip(1)  # TorchRL says float, but broadcasts tensors
        reversed_time = (rewards.flip(1), begins.flip(1))
        following, _ = generalized_advantage_estimate(discount, 1.0, zero, zero, *reversed_time, time_dim=-3)
        returns = following.flip(1)
        self.norm.update(returns)
        self.returns.copy_(returns[:, -1] * ~done[:, -1])
