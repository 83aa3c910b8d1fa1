"""Recurrent actors: a gated recurrent unit for each UAV, with weights that all UAVs share."""

from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, InitTracker, TensorDictPrimer, TransformedEnv
from torchrl.modules import recurrent_mode

from damian import keys

RECURRENT_KEYS: list[NestedKey] = [keys.HIDDEN_BEFORE, keys.IS_INIT]
"""Entries, besides observations, that ``AgentGRU`` reads in recurrent mode."""


class RecurrentModule(TensorDictModuleBase):
    """A module of a policy whose state an environment carries from step to step
    (``add_recurrent_state``)."""

    def state_spec(self, env: EnvBase) -> Composite:
        """The entries of the state, for an environment [B]; they are zeros at a reset."""
        raise NotImplementedError


class AgentGRU(RecurrentModule):
    """Gated recurrent unit from observations to hidden states, for each UAV by itself
    (Cho et al. 2014).

    A single step [B]: reads ``("agents", "observation")`` [B, N, F] and ``("agents", "hidden")``
    [B, N, H]; writes the next hidden state, and the previous one as
    ``("agents", "hidden_before")``. A whole sequence [B, T], in TorchRL's recurrent mode: starts
    from the first ``hidden_before``, and from zeros where ``is_init`` [B, T, 1] marks a new
    episode.
    """

    def __init__(self, encoder: nn.Module, n_features: int, n_hidden: int) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION, keys.HIDDEN]  # type: ignore[assignment]
        self.out_keys = [keys.HIDDEN, keys.HIDDEN_BEFORE]  # type: ignore[assignment]
        self.encoder = encoder
        self.cell = nn.GRUCell(n_features, n_hidden)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        features = self.encoder(tensordict[keys.OBSERVATION])
        if recurrent_mode():
            first = tensordict[keys.HIDDEN_BEFORE][:, 0]
            begins = tensordict[keys.IS_INIT]
            return tensordict.set(keys.HIDDEN, self.replay(features, first, begins))
        before = tensordict[keys.HIDDEN]
        return tensordict.set(keys.HIDDEN_BEFORE, before).set(
            keys.HIDDEN, self.step(features, before)
        )

    def state_spec(self, env: EnvBase) -> Composite:
        shape = cast(Composite, env.observation_spec[keys.AGENTS]).shape
        hidden = Unbounded(torch.Size((*shape, self.cell.hidden_size)))
        agents = Composite(hidden=hidden, shape=shape)
        return Composite(agents=agents, shape=env.batch_size, device=cast(torch.device, env.device))

    def step(self, features: Tensor, hidden: Tensor) -> Tensor:
        """Return the next hidden state from features [*, N, E] and the previous hidden state
        [*, N, H]."""
        return self.cell(features.flatten(0, -2), hidden.flatten(0, -2)).view_as(hidden)

    def replay(self, features: Tensor, hidden: Tensor, begins: Tensor) -> Tensor:
        """The hidden states [B, T, N, H] of a sequence; ``begins`` [B, T, 1] restarts them."""
        states: list[Tensor] = []
        # This loop is as fast as nn.GRU, which cannot restart within a sequence. TorchRL's
        # GRUModule can, but pads episodes and takes twice the time.
        for feature, begin in zip(features.unbind(1), begins.unbind(1), strict=True):
            hidden = self.step(feature, hidden.masked_fill(begin.unsqueeze(-1), 0.0))
            states.append(hidden)
        return torch.stack(states, 1)


def add_recurrent_state(env: TransformedEnv, policy: nn.Module) -> None:
    """Make an environment carry the states of a policy's recurrent modules, with zeros at a
    reset."""
    for module in policy.modules():
        if not isinstance(module, RecurrentModule):
            continue
        spec = module.state_spec(env)
        known = set(env.observation_spec.keys(True, True))
        if known.issuperset(spec.keys(True, True)):
            continue
        env.append_transform(InitTracker(keys.IS_INIT))
        env.append_transform(TensorDictPrimer(spec))
