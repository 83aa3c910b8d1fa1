"""Actors: a model's network, with a memory, a prior, or one network for each UAV, and a
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

FIRST_WEIGHTS = {"gain": 40.0, "choice": 2.0}
"""Initial weights of the gains of actions, and of the action that gains most."""
FIRST_LOG_WEIGHT, LEAST = 8.0, 1e-3
"""Initial weight of the logs of probabilities of a detection, and the lower bound of these."""


def make_actor(env: EnvBase, model: ModelConfig) -> ProbabilisticActor:
    """Make the policy from ``("agents", "observation")`` [*, N, F] to ``("agents", "action")``."""
    layout = layout_at(env, keys.OBSERVATION)
    n_networks = 1 if model.shared else env.observation_spec[keys.OBSERVATION].shape[-2]

    def make(n_out: int, *out_keys: NestedKey) -> TensorDictModule:
        if not model.recurrent:
            networks = [model.make_network(layout, n_out) for _ in range(n_networks)]
            network = networks[0] if model.shared else SeparateNetworks(networks)
            return _module(network, [keys.OBSERVATION], model, layout, out_keys)
        head = model.make_head(layout, n_out)
        memory = AgentGRU(*model.make_encoder(layout), model.hidden[-1])
        after = _module(head, [keys.HIDDEN, keys.OBSERVATION], model, layout, out_keys)
        return TensorDictSequential([memory, after])  # type: ignore[list-item]

    actor = with_distribution(env, make)
    actor.to(env.device)
    return actor


def _module(
    network: nn.Module,
    in_keys: list[NestedKey],
    model: ModelConfig,
    layout: Layout,
    out_keys: tuple[NestedKey, ...],
) -> TensorDictModule:
    """A module that computes the parameters of the actions' distribution from entries; the
    observation is the last of them."""
    if len(out_keys) == 2:
        checks.require(not model.prior, "model.prior", True, "needs discrete actions")
        network = NormalParameters(network, NormalParamExtractor())
    elif model.prior:
        network = Prior(network, layout)
    return TensorDictModule(network, in_keys=in_keys, out_keys=list(out_keys))


class NormalParameters(nn.Sequential):
    """A network, and then what makes location and scale of its outputs."""

    def forward(self, *read: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        """Location and scale [*, n] each."""
        network, extract = self
        return extract(network(*read))


class Prior(nn.Module):
    """Adds to a network's outputs, which are zero at first, the script's gain of each action times a
    learnt weight."""

    def __init__(self, network: nn.Module, layout: Layout) -> None:
        super().__init__()
        self.network = network
        self.log = "belief_gain" in layout
        first = [FIRST_LOG_WEIGHT]
        if self.log:
            self.columns = [layout["belief_gain"].columns]
        else:
            advised = "actions" in layout and "gain" in layout["actions"].entries
            should = (
                "needs gains: observation.actions=true observation.advice=true, or "
                "observation.belief=[belief_gain]"
            )
            checks.require(advised, "model.prior", True, should)
            self.columns = [layout["actions"].columns_of(name) for name in FIRST_WEIGHTS]
            first = [*FIRST_WEIGHTS.values()]
        self.weight = nn.Parameter(torch.tensor(first))
        for parameter in [*network.parameters()][-2:]:  # of the last layer
            nn.init.zeros_(parameter)

    def forward(self, *read: Tensor) -> Tensor:
        """Logits [*, A] from the inputs of the network; the last input is observations [*, F]."""
        logits = self.network(*read)
        for columns, weight in zip(self.columns, self.weight, strict=True):
            gain = read[-1][..., columns]
            logits = logits + weight * (gain.clamp(min=LEAST).log() if self.log else gain)
        return logits
