"""A network for each UAV, evaluated as one batch."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state


class SeparateNetworks(nn.Module):
    """N networks of one architecture, the first of which reads the first UAV's observation, and so
    on."""

    def __init__(self, networks: Sequence[nn.Module]) -> None:
        super().__init__()
        parameters, _ = stack_module_state([*networks])
        self.names = [*parameters]
        self.stacked = nn.ParameterList(parameters.values())
        # In a list, so that this one's own parameters are not among those that are trained.
        self._network = [networks[0].to("meta")]

    def forward(self, observation: Tensor) -> Tensor:
        """Outputs [*, N, n_out] of observations [*, N, F]."""
        (network,) = self._network

        def of_one(stacked: tuple[Tensor, ...], columns: Tensor) -> Tensor:
            return functional_call(network, dict(zip(self.names, stacked, strict=True)), columns)

        return torch.vmap(of_one, in_dims=(0, -2), out_dims=-2)(tuple(self.stacked), observation)
