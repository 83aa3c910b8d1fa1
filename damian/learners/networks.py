"""Actors and critics: one network shared by all UAVs, so that a policy can fly any number of them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import cast

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded, Categorical
from torchrl.envs import EnvBase
from torchrl.modules import MLP, MaskedCategorical, ProbabilisticActor, TanhNormal
from torchrl.modules.distributions import NormalParamExtractor

from damian.common import checks
from damian.learners.recurrent import AgentGRU

_ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}


@dataclass
class ModelConfig:
    """A multilayer perceptron each for actor and critic."""

    hidden: list[int] = field(default_factory=lambda: [256, 256])
    """Width of each hidden layer."""
    activation: str = "tanh"
    """tanh, relu, elu or silu."""
    rnn: str = "none"
    """none or gru: the actor's last hidden layer is a gated recurrent unit, so that a UAV remembers what it
    has seen in an episode."""

    def __post_init__(self) -> None:
        checks.one_of("model.activation", self.activation, _ACTIVATIONS)
        checks.one_of("model.rnn", self.rnn, ["none", "gru"])
        checks.require(not self.recurrent or bool(self.hidden), "model.hidden", [], "is no layer to be a gru")
        for width in self.hidden:
            checks.in_range("model.hidden", width, 1, 16384)

    @property
    def recurrent(self) -> bool:
        """Does the actor remember anything."""
        return self.rnn != "none"

    def network(self, n_in: int, n_out: int, device: torch.device | None) -> MLP:
        """Features [*, n_in] to outputs [*, n_out]."""
        activation = _ACTIVATIONS[self.activation]
        return MLP(n_in, n_out, num_cells=self.hidden, activation_class=activation, device=device)

    def gru(self, n_in: int, device: torch.device | None) -> AgentGRU:
        """All hidden layers, the last one recurrent, for features [*, n_in]."""
        *widths, n_hidden = self.hidden
        if not widths:
            return AgentGRU(nn.Identity(), n_in, n_hidden, device)
        *cells, n_out = widths
        activation = _ACTIVATIONS[self.activation]
        encoder = MLP(
            n_in, n_out, num_cells=cells, activation_class=activation, activate_last_layer=True, device=device
        )
        return AgentGRU(encoder, n_out, n_hidden, device)


def make_actor(env: EnvBase, config: ModelConfig) -> ProbabilisticActor:
    """Policy from ``("agents", "observation")`` [*, N, F] to ``("agents", "action")``.

    Discrete actions: a categorical distribution over the legal ones. Continuous actions: a tanh-normal
    on their bounds.
    """
    spec = env.full_action_spec_unbatched["agents", "action"]
    if isinstance(spec, Categorical):
        masked = _has_mask(env)
        keys = {"logits": ("agents", "logits")}
        return ProbabilisticActor(
            _actor_network(env, config, spec.n, "logits"),
            in_keys=keys | {"mask": ("agents", "action_mask")} if masked else keys,  # type: ignore[arg-type]
            out_keys=[("agents", "action")],
            distribution_class=MaskedCategorical if masked else torch.distributions.Categorical,
            distribution_kwargs={"neg_inf": -1e8} if masked else {},
            return_log_prob=True,
            log_prob_key=("agents", "action_log_prob"),
        )
    bounds = cast(Bounded, spec)
    low, high = (bound.reshape(-1, spec.shape[-1])[0] for bound in (bounds.low, bounds.high))
    return ProbabilisticActor(
        _actor_network(env, config, 2 * spec.shape[-1], "loc", "scale"),
        in_keys=[("agents", "loc"), ("agents", "scale")],
        out_keys=[("agents", "action")],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": low, "high": high},
        return_log_prob=True,
        log_prob_key=("agents", "action_log_prob"),
    )


def _actor_network(env: EnvBase, config: ModelConfig, n_out: int, *shown: str) -> TensorDictModule:
    """What is seen to the parameters of a distribution, by name: logits, or location and scale."""
    n_features = env.observation_spec["agents", "observation"].shape[-1]

    def show(network: nn.Module, seen: str) -> TensorDictModule:
        normal = shown == ("loc", "scale")
        return _module(nn.Sequential(network, NormalParamExtractor()) if normal else network, seen, *shown)

    if not config.recurrent:
        return show(config.network(n_features, n_out, env.device), "observation")
    head = nn.Linear(config.hidden[-1], n_out, device=env.device)
    gru = config.gru(n_features, env.device)
    return TensorDictSequential([gru, show(head, "hidden")])  # type: ignore[list-item]


def make_critic(env: EnvBase, config: ModelConfig, seen: str = "global_observation") -> TensorDictModule:
    """Values ``("agents", "state_value")`` [*, N, 1] from what the critic sees, ``("agents", seen)``."""
    n_features = env.observation_spec["agents", seen].shape[-1]
    return _module(config.network(n_features, 1, env.device), seen, "state_value")


def make_action_value(
    env: EnvBase, config: ModelConfig, seen: str = "global_observation"
) -> TensorDictModule:
    """Values of actions, from what the critic sees and what the actor does.

    Without what the actor sees, such as its past actions, the actor could not learn what these are good for.

    Returns:
        discrete: ``action_value`` [*, A], of each action; continuous: ``state_action_value`` [*, 1], of
        ``("agents", "action")``.
    """
    keys: list[NestedKey] = [("agents", name) for name in dict.fromkeys((seen, "observation"))]
    n_seen = sum(env.observation_spec[key].shape[-1] for key in keys)
    spec = env.full_action_spec_unbatched["agents", "action"]
    if isinstance(spec, Categorical):
        return TensorDictModule(config.network(n_seen, spec.n, env.device), keys, ["action_value"])
    network = config.network(n_seen + spec.shape[-1], 1, env.device)
    return TensorDictModule(network, [*keys, ("agents", "action")], ["state_action_value"])


def _has_mask(env: EnvBase) -> bool:
    return ("agents", "action_mask") in env.observation_spec.keys(True, True)


def _module(network: Callable[..., torch.Tensor], seen: str, *shown: str) -> TensorDictModule:
    keys: list[NestedKey] = [("agents", name) for name in shown]
    return TensorDictModule(network, in_keys=[("agents", seen)], out_keys=keys)
