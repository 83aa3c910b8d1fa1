"""Multilayer perceptrons."""

from collections.abc import Sequence

from torch import Tensor, nn
from torchrl.modules import MLP

from damian.models.config import ModelConfig

ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}


def make_mlp(config: ModelConfig, n_in: int, n_out: int) -> MLP:
    """Make a multilayer perceptron."""
    activation = ACTIVATIONS[config.activation]
    return MLP(n_in, n_out, num_cells=config.hidden, activation_class=activation)


def hidden_layers(config: ModelConfig, n_in: int, widths: Sequence[int]) -> MLP:
    """Make layers of these widths, each with its activation, for features [*, n_in]."""
    *inner, n_out = widths
    activation = ACTIVATIONS[config.activation]
    return MLP(n_in, n_out, num_cells=inner, activation_class=activation, activate_last_layer=True)


def make_encoder(config: ModelConfig, n_in: int) -> tuple[nn.Module, int]:
    """Make all hidden layers but the last one, and tell the width of what they give."""
    *widths, _ = config.hidden
    return (hidden_layers(config, n_in, widths), widths[-1]) if widths else (nn.Identity(), n_in)


def activated(network: nn.Module, activation: str) -> nn.Module:
    """A network whose outputs pass an activation function."""
    return nn.Sequential(network, ACTIVATIONS[activation]())


class LinearHead(nn.Linear):
    """A last layer that reads nothing but features."""

    def forward(self, features: Tensor, observation: Tensor) -> Tensor:  # type: ignore[override]
        """Outputs [*, n_out] of features [*, n_in]."""
        return super().forward(features)
