"""Critics: values of observations, and values of actions."""

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Categorical
from torchrl.envs import EnvBase
from torchrl.modules import PopArtValueNorm

from damian import keys
from damian.models.config import ModelConfig
from damian.server.layout import joined, layout_at

FORGETTING = 0.99
"""Share of the running statistics of values that an update keeps: they reflect about the last 100
updates."""


def make_critic(
    env: EnvBase,
    model: ModelConfig,
    critic_key: NestedKey = keys.GLOBAL_OBSERVATION,
    normalize: bool = False,
) -> TensorDictModule:
    """Make the critic, from its observation [*, N, G] to values ``("agents", "state_value")``
    [*, N, 1]."""
    layout = layout_at(env, critic_key)
    if model.shared_value:
        network: nn.Module = SharedValue(
            model.make_network(joined([layout] * env.observation_spec[critic_key].shape[-2]), 1)
        )
    else:
        network = model.make_network(layout, 1)
    if normalize:
        network = NormalizedValue(network)
    return TensorDictModule(network, in_keys=[critic_key], out_keys=[keys.STATE_VALUE]).to(
        env.device
    )


def make_action_value(env: EnvBase, model: ModelConfig, read: list[NestedKey]) -> TensorDictModule:
    """Make a Q-function of the entries ``read``: values of all discrete actions, or of the one."""
    layout = joined([layout_at(env, key) for key in read])
    spec = env.full_action_spec_unbatched[keys.ACTION]
    if isinstance(spec, Categorical):
        in_keys = read
        out_key = "action_value"
        n_out = spec.n
    else:
        in_keys = [*read, keys.ACTION]
        out_key = "state_action_value"
        n_out = 1
        layout = layout.appended("action", (spec.shape[-1],))
    network = JoinedInputs(model.make_network(layout, n_out))
    return TensorDictModule(network, in_keys=in_keys, out_keys=[out_key]).to(env.device)


class JoinedInputs(nn.Module):
    """A network that reads several entries, one behind the other."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, *entries: Tensor) -> Tensor:
        """The outputs of the network for entries [*, F1], [*, F2], ..."""
        return self.network(torch.cat(entries, -1))


class SharedValue(nn.Module):
    """One value for all UAVs of a world, from the features of all of them, [*, N G]."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, observations: Tensor) -> Tensor:
        """The value of observations [*, N, G], the same for each UAV, [*, N, 1]."""
        value = self.network(observations.flatten(-2)).unsqueeze(-2)
        return value.expand(*observations.shape[:-1], 1)


class NormalizedValue(nn.Module):
    """Values from a network whose outputs are values of mean 0 and standard deviation 1
    (Yu et al. 2022)."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        # TorchRL's smallest variance, 1e-5, is that of rewards which are merely small.
        norm = PopArtValueNorm(beta=FORGETTING, epsilon=1e-16)
        self.norm = norm.double()  # the variance is a difference of squares

    def forward(self, observations: Tensor) -> Tensor:
        """Return the values of observations [*, N, G] in the unit of the rewards, [*, N, 1]."""
        value = self.network(observations)
        return self.norm.denormalize(value).to(value.dtype)
