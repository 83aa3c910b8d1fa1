"""Your own network: UAVs attend to what they have heard of each other, however late it came.

    cd examples/extending
    damian train scenario=delaybench/crowded links=matrix links.delay=4 delay.obs=4 aware=backupdate \\
        "observation.global_features=[talking:heard,coverage,coverage_map]" learner=talking:TalkingConfig

Every UAV sends its message to every other one; what it says is encoded by a network that all UAVs share and
that is learnt with the policy, and whoever hears it weighs it by attention, which reads its age (TarMAC, Das
et al. 2019, with late messages). As the encoder is shared, whoever receives a message can encode it as well
as its sender; so the gradient needs no way back through the link. Works with any number of UAVs.
"""

from dataclasses import dataclass
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase

from damian import feature, keys
from damian.common import checks
from damian.common.tensors import gather_rows
from damian.learners.config import MappoConfig, ModelConfig
from damian.learners.networks import hidden_layers, make_mlp, with_distribution
from damian.server.features import FeatureCache, feature_of
from damian.server.features.others import of_others

HEARD = "talking:heard"


@feature("global", [None], low=-1.0)
def heard(v: FeatureCache) -> Tensor:
    """What the UAV holds of each other UAV, [*, N, (N - 1) K] with K = 2 ``observation.window`` + 4.

    The ways to its target and to its latest landing points, east and north, over half the largest vertex
    distance of the region; whether it spots the source; and the age of the message, over ten seconds.
    """
    messages, own = v.messages, v.wanted(v.messages.target)
    landed = gather_rows(v.context.points, v.trail)  # [*, N, window, 2]
    places = torch.cat([messages.target.unsqueeze(-2), landed], -2)
    ways = places.unsqueeze(-4) - own[..., :, None, None, :]
    ways = (ways / (v.context.scale / 2)[..., None, None, None, None]).flatten(-2)  # [*, N, N, 2 + 2 window]
    age = messages.age(v.context.now) / v.context.observation.age_scale
    rest = torch.stack([messages.spotted.float(), age], -1).unsqueeze(-3).expand(*ways.shape[:-1], 2)
    return of_others(v, torch.cat([ways, rest], -1)).clamp(-1, 1).flatten(-2)


@dataclass
class TalkingConfig(MappoConfig):
    """MAPPO whose actor attends to what it has heard."""

    heads: int = 4
    """Heads of the attention."""
    width: int = 64
    """Width of what is said, over all heads."""

    def __post_init__(self) -> None:
        super().__post_init__()
        should = f"is not divisible by learner.heads={self.heads}"
        checks.require(self.width % self.heads == 0, "learner.width", self.width, should)

    def make_actor(self, env: EnvBase, model: ModelConfig) -> Any:
        observation = env.scenario.observation  # type: ignore[attr-defined]
        names = observation.actor
        should = f"must begin with {HEARD}"
        checks.require(feature_of(names[0]) is heard, "observation.global_features", names, should)
        n_agents, n_columns = env.observation_spec[keys.OBSERVATION].shape[-2:]
        shape = (n_agents - 1, 2 * observation.window + 4)

        def make(n_out: int, *out_keys: Any) -> TensorDictModule:
            network = Attention(model, shape, n_columns, n_out, self.heads, self.width)
            return TensorDictModule(network.to(env.device), [keys.OBSERVATION], list(out_keys))

        return with_distribution(env, make)


class Attention(nn.Module):
    """From observations [*, (N - 1) K + F] to the parameters of the actions' distribution, [*, A]."""

    def __init__(
        self,
        model: ModelConfig,
        shape: tuple[int, int],
        n_columns: int,
        n_out: int,
        heads: int,
        width: int,
    ) -> None:
        super().__init__()
        self.shape, self.heads = shape, heads
        n_own = n_columns - shape[0] * shape[1]
        self.says = hidden_layers(model, shape[1], [width], None)
        self.key_and_value = nn.Linear(width, 2 * width)
        self.query = nn.Linear(n_own, width)
        self.decides = make_mlp(model, n_own + width, n_out, None)

    def forward(self, observation: Tensor) -> Tensor:
        n_heard = self.shape[0] * self.shape[1]
        rows = observation[..., :n_heard].unflatten(-1, self.shape)
        own = observation[..., n_heard:]
        key, value = self.key_and_value(self.says(rows)).unflatten(-1, (self.heads, -1)).chunk(2, -1)
        query = self.query(own).unflatten(-1, (1, self.heads, -1))
        weight = ((query * key).sum(-1, keepdim=True) / key.shape[-1] ** 0.5).softmax(-3)  # of each UAV heard
        return self.decides(torch.cat([own, (weight * value).sum(-3).flatten(-2)], -1))
