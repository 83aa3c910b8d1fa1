"""Actors: a model's network, with a memory, a skip connection, or one network for each UAV, and a
policy."""

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import NormalParamExtractor, ProbabilisticActor

from damian import keys
from damian.common import checks
from damian.models.config import ModelConfig
from damian.models.distribution import with_distribution
from damian.models.memory import AgentGRU
from damian.models.separate import SeparateNetworks
from damian.server.layout import Layout, layout_at

FIRST_WEIGHT, LEAST = 8.0, 1e-3
"""Initial weight of a skip connection, and the lower bound of the probabilities of which it takes
the log."""


def make_actor(env: EnvBase, model: ModelConfig) -> ProbabilisticActor:
    """Make the policy from ``("agents", "observation")`` [*, N, F] to ``("agents", "action")``."""
    layout = layout_at(env, keys.OBSERVATION)
    shape = env.observation_spec[keys.OBSERVATION].shape

    def make(n_out: int, *out_keys: NestedKey) -> TensorDictModule:
        if not model.recurrent:
            network = _network(model, layout, n_out, shape)
            return _module(network, keys.OBSERVATION, model, layout, out_keys)
        head = nn.Linear(model.hidden[-1], n_out)
        memory = AgentGRU(*model.make_encoder(layout), model.hidden[-1])
        after = _module(head, keys.HIDDEN, model, layout, out_keys)
        return TensorDictSequential([memory, after])  # type: ignore[list-item]

    actor = with_distribution(env, make)
    actor.to(env.device)
    return actor


def _network(model: ModelConfig, layout: Layout, n_out: int, observed: torch.Size) -> nn.Module:
    """The network that all UAVs share, or one for each of them."""
    if model.shared:
        return model.make_network(layout, n_out)
    return SeparateNetworks([model.make_network(layout, n_out) for _ in range(observed[-2])])


def _module(
    network: nn.Module,
    in_key: NestedKey,
    model: ModelConfig,
    layout: Layout,
    out_keys: tuple[NestedKey, ...],
) -> TensorDictModule:
    """A network from an entry to the parameters of the actions' distribution."""
    normal = len(out_keys) == 2
    if model.skip:
        should = "needs a probability for each discrete action: observation.belief=[belief_gain]"
        checks.require("belief_gain" in layout and not normal, "model.skip", True, should)
        skipping = SkipConnection(network, layout["belief_gain"].columns)
        return TensorDictModule(
            skipping, in_keys=[in_key, keys.OBSERVATION], out_keys=list(out_keys)
        )
    module = nn.Sequential(network, NormalParamExtractor()) if normal else network
    return TensorDictModule(module, in_keys=[in_key], out_keys=list(out_keys))


class SkipConnection(nn.Module):
    """A network's outputs, zero at first, plus the logs of the observation's ``columns`` times a
    weight."""

    def __init__(self, network: nn.Module, columns: slice) -> None:
        super().__init__()
        self.network = network
        self.columns = columns
        self.weight = nn.Parameter(torch.tensor(FIRST_WEIGHT))
        last = [each for each in network.modules() if isinstance(each, nn.Linear)][-1]
        for parameter in last.parameters():
            nn.init.zeros_(parameter)

    def forward(self, features: Tensor, observation: Tensor) -> Tensor:
        """Logits [*, A] of the network's input [*, H] and observations [*, F]."""
        log = observation[..., self.columns].clamp(min=LEAST).log()
        return self.network(features) + self.weight * log
