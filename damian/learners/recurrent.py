"""Actors that remember: a gated recurrent unit for each UAV, with weights shared by all of them."""

from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Composite, Unbounded
from torchrl.envs import InitTracker, TensorDictPrimer, TransformedEnv
from torchrl.modules import recurrent_mode

from damian import keys

RECURRENT_KEYS: list[NestedKey] = [keys.HIDDEN_BEFORE, keys.IS_INIT]
"""Entries that the replay of a sequence reads, beside observations."""


class AgentGRU(TensorDictModuleBase):
    """Hidden states from what is seen (Cho et al. 2014).

    Step by step, batch [B]: reads ``("agents", "observation")`` [B, N, F] and ``("agents", "hidden")``
    [B, N, H]; writes the latter anew, and as ``("agents", "hidden_before")`` what it was. In TorchRL's
    recurrent mode, which its losses switch on, whole sequences [B, T]: from the first ``hidden_before``, and
    from zeros wherever ``is_init`` [B, T, 1] says that an episode begins.

    Args:
        encoder: observations [*, F] to features [*, E].
        n_features: E.
        n_hidden: H.
        device: of the cell.
    """

    def __init__(
        self, encoder: nn.Module, n_features: int, n_hidden: int, device: torch.device | None = None
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [keys.OBSERVATION, keys.HIDDEN], [keys.HIDDEN, keys.HIDDEN_BEFORE]  # type: ignore[assignment]
        self.encoder, self.cell = encoder, nn.GRUCell(n_features, n_hidden, device=device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        features = self.encoder(tensordict[keys.OBSERVATION])
        if recurrent_mode():
            first, begins = tensordict[keys.HIDDEN_BEFORE][:, 0], tensordict[keys.IS_INIT]
            return tensordict.set(keys.HIDDEN, self.replay(features, first, begins))
        before = tensordict[keys.HIDDEN]
        return tensordict.set(keys.HIDDEN_BEFORE, before).set(keys.HIDDEN, self.step(features, before))

    def step(self, features: Tensor, hidden: Tensor) -> Tensor:
        """The hidden state after [*, N, H] from features [*, N, E] and the one before [*, N, H]."""
        return self.cell(features.flatten(0, -2), hidden.flatten(0, -2)).view_as(hidden)

    def replay(self, features: Tensor, hidden: Tensor, begins: Tensor) -> Tensor:
        """Hidden states after every step [B, T, N, H].

        Args:
            features: [B, T, N, E].
            hidden: before the first step, [B, N, H].
            begins: does an episode begin with a step, [B, T, 1] bool.
        """
        after: list[Tensor] = []
        # As fast as nn.GRU, which knows no beginnings; TorchRL's GRUModule pads episodes, at twice the time.
        for feature, begin in zip(features.unbind(1), begins.unbind(1), strict=True):
            hidden = self.step(feature, hidden.masked_fill(begin.unsqueeze(-1), 0.0))
            after.append(hidden)
        return torch.stack(after, 1)


def add_recurrent_state(env: TransformedEnv, policy: nn.Module) -> None:
    """Let an environment carry the hidden states of a policy, zeros at a reset; once, and only if it has
    any."""
    cells = [module.cell for module in policy.modules() if isinstance(module, AgentGRU)]
    if not cells or keys.HIDDEN in env.observation_spec.keys(True, True):
        return
    shape = cast(Composite, env.observation_spec[keys.AGENTS]).shape
    agents = Composite(hidden=Unbounded(torch.Size((*shape, cells[0].hidden_size))), shape=shape)
    primer = Composite(agents=agents, shape=env.batch_size, device=cast(torch.device, env.device))
    env.append_transform(InitTracker(keys.IS_INIT))
    env.append_transform(TensorDictPrimer(primer))
