"""Actors and critics: one network shared by all UAVs, so that a policy can fly any number of them."""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Categorical
from torchrl.envs import EnvBase
from torchrl.modules import MLP, MaskedCategorical, ProbabilisticActor, TanhNormal
from torchrl.modules.distributions import NormalParamExtractor

from damian import checks

_ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}


@dataclass
class ModelConfig:
    """A multilayer perceptron each for actor and critic."""

    hidden: list[int] = field(default_factory=lambda: [256, 256])
    """Width of each hidden layer."""
    activation: str = "tanh"
    """tanh, relu, elu or silu."""

    def __post_init__(self) -> None:
        checks.one_of("model.activation", self.activation, _ACTIVATIONS)
        for width in self.hidden:
            checks.in_range("model.hidden", width, 1, 16384)

    def network(self, n_in: int, n_out: int, device: torch.device | None) -> MLP:
        """Features [*, n_in] to outputs [*, n_out]."""
        activation = _ACTIVATIONS[self.activation]
        return MLP(n_in, n_out, num_cells=self.hidden, activation_class=activation, device=device)


def make_actor(env: EnvBase, config: ModelConfig) -> ProbabilisticActor:
    """Policy from ``("agents", "observation")`` [*, N, F] to ``("agents", "action")``.

    Discrete actions: a categorical distribution over the legal ones. Continuous actions: a tanh-normal
    on [0, 1].
    """
    n_features = env.observation_spec["agents", "observation"].shape[-1]
    spec = env.full_action_spec_unbatched["agents", "action"]
    if isinstance(spec, Categorical):
        network = config.network(n_features, spec.n, env.device)
        masked = _has_mask(env)
        keys = {"logits": ("agents", "logits")}
        return ProbabilisticActor(
            _module(network, "observation", "logits"),
            in_keys=keys | {"mask": ("agents", "action_mask")} if masked else keys,  # type: ignore[arg-type]
            out_keys=[("agents", "action")],
            distribution_class=MaskedCategorical if masked else torch.distributions.Categorical,
            distribution_kwargs={"neg_inf": -1e8} if masked else {},
            return_log_prob=True,
            log_prob_key=("agents", "action_log_prob"),
        )
    network = config.network(n_features, 2 * spec.shape[-1], env.device)
    return ProbabilisticActor(
        _module(nn.Sequential(network, NormalParamExtractor()), "observation", "loc", "scale"),
        in_keys=[("agents", "loc"), ("agents", "scale")],
        out_keys=[("agents", "action")],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": 0.0, "high": 1.0},
        return_log_prob=True,
        log_prob_key=("agents", "action_log_prob"),
    )


def make_critic(env: EnvBase, config: ModelConfig) -> TensorDictModule:
    """Values ``("agents", "state_value")`` [*, N, 1] from ``("agents", "global_observation")``."""
    n_features = env.observation_spec["agents", "global_observation"].shape[-1]
    return _module(config.network(n_features, 1, env.device), "global_observation", "state_value")


def random_policy(env: EnvBase) -> TensorDictModule:
    """Uniform over the legal actions: what every result is compared with."""

    def draw(seen: torch.Tensor) -> torch.Tensor:
        if masked:
            return torch.multinomial(seen.flatten(0, -2).float(), 1).view(seen.shape[:-1])
        return spec.rand(seen.shape[:1])

    spec, masked = env.full_action_spec_unbatched["agents", "action"], _has_mask(env)
    seen = "action_mask" if masked else "observation"
    return _module(draw, seen, "action")


def _has_mask(env: EnvBase) -> bool:
    return ("agents", "action_mask") in env.observation_spec.keys(True, True)


def _module(network: Callable[..., torch.Tensor], seen: str, *shown: str) -> TensorDictModule:
    keys: list[NestedKey] = [("agents", name) for name in shown]
    return TensorDictModule(network, in_keys=[("agents", seen)], out_keys=keys)
