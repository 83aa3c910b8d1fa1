"""Your own model: a UAV attends to what it knows of each other UAV, however late that came.

    cd examples/extending
    damian train scenario=delaybench/crowded delay.obs=4 aware=backupdate model=talking:AttentionConfig
    ... links=matrix links.delay=4 "observation.global_features=[talking:heard,coverage,coverage_map]"

What is known of the others stands in blocks of rows of the UAV's own observation (``env.layout``):
those of ``others``, of ``requests``, or, where every UAV sends its message to every other one, of
the feature ``heard`` below, with the age of each message (TarMAC,
Das et al. 2019, with late messages). One network encodes the rows of a block, and attention weighs
them, so that it works with any number of UAVs, in any order. Whoever receives a message can encode
it as well as its sender: the gradient needs no way back through a link.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from damian import ModelConfig, feature
from damian.common.fields import setting
from damian.common.tensors import gather_rows
from damian.models.mlp import hidden_layers, make_mlp
from damian.server.features import FeatureCache
from damian.server.features.others import of_others
from damian.server.layout import Layout


@feature("global", [None, None], low=-1.0, rows="others")
def heard(v: FeatureCache) -> Tensor:
    """What the UAV holds of each other UAV, [*, N, N - 1, K] with K = 2 ``observation.window`` + 5.

    The ways to its target and to its latest landing points, east and north, over half the largest
    vertex distance of the region; whether it spots the source; the age of the message, over ten
    seconds; and 1.
    """
    messages = v.messages
    own = v.wanted(v.messages.target)
    landed = gather_rows(v.context.points, v.trail)  # [*, N, window, 2]
    places = torch.cat([messages.target.unsqueeze(-2), landed], -2)
    ways = places.unsqueeze(-4) - own[..., :, None, None, :]
    ways = (ways / (v.context.scale / 2)[..., None, None, None, None]).flatten(
        -2
    )  # [*, N, N, 2 + 2 window]
    age = messages.age(v.context.now) / v.context.observation.age_scale
    rest = torch.stack([messages.spotted.float(), age, torch.ones_like(age)], -1)
    rest = rest.unsqueeze(-3).expand(*ways.shape[:-1], 3)
    return of_others(v, torch.cat([ways, rest], -1)).clamp(-1, 1)


@dataclass
class AttentionConfig(ModelConfig):
    """A network that attends over each block of rows."""

    width: int = setting(32, "Width of what is read from a block of rows.", low=1, high=1024)

    def make_network(self, layout: Layout, n_out: int) -> nn.Module:
        self.refuse(
            not any(block.rows for block in layout),
            "name",
            "needs a feature of rows, such as others",
        )
        return Attention(self, layout, n_out)


class Attention(nn.Module):
    """From observations [*, F] to [*, n_out]."""

    def __init__(self, model: AttentionConfig, layout: Layout, n_out: int) -> None:
        super().__init__()
        self.rows = [block for block in layout if block.rows]
        self.rest = [block for block in layout if not block.rows]
        n_rest = sum(block.width for block in self.rest)
        sizes = [block.width // block.shape[0] for block in self.rows]
        self.encode = nn.ModuleList(hidden_layers(model, size, [model.width]) for size in sizes)
        self.query = nn.ModuleList(nn.Linear(n_rest, model.width) for _ in sizes)
        self.decide = make_mlp(model, n_rest + len(sizes) * model.width, n_out)

    def forward(self, observation: Tensor) -> Tensor:
        rest = torch.cat([observation[..., block.columns] for block in self.rest], -1)
        read = [self.attended(i, observation, rest) for i in range(len(self.rows))]
        return self.decide(torch.cat([rest, *read], -1))

    def attended(self, i: int, observation: Tensor, rest: Tensor) -> Tensor:
        """The mean of the encoded rows of a block, weighed by how well they match a query,
        [*, width]."""
        rows = self.rows[i].of(observation).flatten(observation.dim())  # [*, R, K]
        encoded = self.encode[i](rows)
        query = self.query[i](rest).unsqueeze(-1)
        match = encoded @ query / encoded.shape[-1] ** 0.5  # [*, R, 1]
        exists = (rows != 0).any(-1, keepdim=True)
        weight = match.masked_fill(~exists, -1e4).softmax(-2) * exists
        return (weight * encoded).sum(-2)
