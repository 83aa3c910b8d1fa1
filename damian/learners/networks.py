"""Actors and critics: all UAVs share one network, so that a policy works with any number of UAVs."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.data import Bounded, Categorical
from torchrl.envs import EnvBase
from torchrl.modules import MLP, MultiAgentMLP, PopArtValueNorm, ProbabilisticActor, TanhNormal
from torchrl.modules.distributions import NormalParamExtractor

from damian import keys
from damian.common import checks
from damian.learners.config import ModelConfig
from damian.learners.recurrent import AgentGRU

COMPILE_OPTIONS = {
    "cpp.use_decompose_tanh": True,  # by exponentials, in half the time; the difference is rounding
    "fallback_random": True,  # the draws of torch's generator, as without compiling
    "cpp.vec_isa_ok": True,  # by the processor's flags, without a trial
}
"""Options of ``torch.compile`` for networks."""
FIRST_WEIGHT, LEAST = 8.0, 1e-3
"""Initial weight of a skip connection, and the lower bound of the probabilities of which it takes the log."""
FORGETTING = 0.99
"""Share of the running statistics of values that an update keeps: they reflect about the last 100 updates."""
_ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}


def make_mlp(config: ModelConfig, n_in: int, n_out: int, device: torch.device | None) -> MLP:
    """Make a multilayer perceptron."""
    activation = _ACTIVATIONS[config.activation]
    return MLP(n_in, n_out, num_cells=config.hidden, activation_class=activation, device=device)


def hidden_layers(config: ModelConfig, n_in: int, widths: Sequence[int], device: torch.device | None) -> MLP:
    """Make layers of these widths, each with its activation, for features [*, n_in]."""
    *inner, n_out = widths
    kind = _ACTIVATIONS[config.activation]
    options: dict[str, Any] = {"activation_class": kind, "activate_last_layer": True, "device": device}
    return MLP(n_in, n_out, num_cells=inner, **options)


class LegalCategorical(Distribution):
    """Categorical distribution of logits [*, A] over legal actions; TorchRL's takes four times as long.

    Actions are drawn by the inverse of the cumulative distribution, in a third of the time of
    ``torch.multinomial``.
    """

    def __init__(self, logits: Tensor, mask: Tensor | None = None) -> None:
        lowest = torch.finfo(logits.dtype).min
        logits = logits.clamp(min=lowest / 4)  # finite, so that an entropy is
        if mask is not None:
            logits = logits.masked_fill(~mask, lowest / 2)  # far below all legal ones, whatever these are
        self.logits = logits.log_softmax(-1)
        super().__init__(logits.shape[:-1], validate_args=False)

    @property
    def probs(self) -> Tensor:
        """Probability of each action, [*, A]."""
        return self.logits.exp()

    @property
    def deterministic_sample(self) -> Tensor:
        """The most likely action, [*]."""
        return self.logits.argmax(-1)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Draw actions, [*sample_shape, *]."""
        cumulative = self.probs.cumsum(-1)
        drawn = torch.rand(*sample_shape, *self.batch_shape, 1, device=cumulative.device)
        # Below the last sum even after rounding; an action of probability 0 adds nothing to the one before.
        return (cumulative <= drawn * cumulative[..., -1:]).sum(-1)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability of actions [*sample_shape, *], finite but very low where they are illegal."""
        logits = self.logits.expand(*value.shape, -1)
        return logits.gather(-1, value.unsqueeze(-1)).squeeze(-1)

    def entropy(self) -> Tensor:
        """Entropy, [*]."""
        return -(self.probs * self.logits).sum(-1)


def make_actor(env: EnvBase, config: ModelConfig) -> ProbabilisticActor:
    """Make the policy from ``("agents", "observation")`` [*, N, F] to ``("agents", "action")``."""
    return with_distribution(env, lambda *out: _actor_network(env, config, *out))


def with_distribution(env: EnvBase, make_network: Callable[..., TensorDictModule]) -> ProbabilisticActor:
    """Make a policy of a network, which is made from its number of outputs and their keys."""
    spec = env.full_action_spec_unbatched[keys.ACTION]
    if isinstance(spec, Categorical):
        masked = keys.ACTION_MASK in env.observation_spec.keys(True, True)
        in_keys = {"logits": keys.LOGITS}
        return ProbabilisticActor(
            make_network(spec.n, keys.LOGITS),
            in_keys=in_keys | {"mask": keys.ACTION_MASK} if masked else in_keys,  # type: ignore[arg-type]
            out_keys=[keys.ACTION],
            distribution_class=LegalCategorical,
            return_log_prob=True,
            log_prob_key=keys.ACTION_LOG_PROB,
        )
    bounds = cast(Bounded, spec)
    low, high = (bound.reshape(-1, spec.shape[-1])[0] for bound in (bounds.low, bounds.high))
    return ProbabilisticActor(
        make_network(2 * spec.shape[-1], keys.LOC, keys.SCALE),
        in_keys=[keys.LOC, keys.SCALE],
        out_keys=[keys.ACTION],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": low, "high": high},
        return_log_prob=True,
        log_prob_key=keys.ACTION_LOG_PROB,
    )


def _actor_network(env: EnvBase, config: ModelConfig, n_out: int, *out_keys: NestedKey) -> TensorDictModule:
    """Network from observations to the parameters of the actions' distribution, under ``out_keys``."""
    n_features = env.observation_spec[keys.OBSERVATION].shape[-1]

    def head(network: nn.Module, in_key: NestedKey) -> TensorDictModule:
        if config.skip:  # the columns of the observation that have a probability for each action
            columns = getattr(env, "action_columns", None)
            should = "needs a probability for each discrete action: observation.belief=[belief_gain]"
            checks.require(columns is not None, "model.skip", True, should)
            module: nn.Module = SkipConnection(network, cast(slice, columns))
            return TensorDictModule(module, in_keys=[in_key, keys.OBSERVATION], out_keys=list(out_keys))
        normal = len(out_keys) == 2
        module = nn.Sequential(network, NormalParamExtractor()) if normal else network
        return TensorDictModule(module, in_keys=[in_key], out_keys=list(out_keys))

    if not config.recurrent:
        if config.shared:
            return head(make_mlp(config, n_features, n_out, env.device), keys.OBSERVATION)
        options = {"num_cells": config.hidden, "activation_class": _ACTIVATIONS[config.activation]}
        n_agents = env.observation_spec[keys.OBSERVATION].shape[-2]
        shape = {"n_agent_inputs": n_features, "n_agent_outputs": n_out, "n_agents": n_agents}
        network = MultiAgentMLP(**shape, centralized=False, share_params=False, device=env.device, **options)
        return head(network, keys.OBSERVATION)
    linear = nn.Linear(config.hidden[-1], n_out, device=env.device)
    *widths, n_hidden = config.hidden
    encoder = hidden_layers(config, n_features, widths, env.device) if widths else nn.Identity()
    gru = AgentGRU(encoder, widths[-1] if widths else n_features, n_hidden, env.device)
    return TensorDictSequential([gru, head(linear, keys.HIDDEN)])  # type: ignore[list-item]


class SkipConnection(nn.Module):
    """A network's outputs, zero at first, plus the logs of the observation's ``columns`` times a weight."""

    def __init__(self, network: nn.Module, columns: slice) -> None:
        super().__init__()
        self.network, self.columns = network, columns
        self.weight = nn.Parameter(torch.tensor(FIRST_WEIGHT))
        last = [each for each in network.modules() if isinstance(each, nn.Linear)][-1]
        for parameter in last.parameters():
            nn.init.zeros_(parameter)
        self.to(last.weight.device)

    def forward(self, features: Tensor, observation: Tensor) -> Tensor:
        """Logits [*, A] of the network's input [*, H] and observations [*, F]."""
        log = observation[..., self.columns].clamp(min=LEAST).log()
        return self.network(features) + self.weight * log


def make_critic(
    env: EnvBase,
    config: ModelConfig,
    critic_key: NestedKey = keys.GLOBAL_OBSERVATION,
    normalize: bool = False,
) -> TensorDictModule:
    """Make the critic, from its observation [*, N, G] to values ``("agents", "state_value")`` [*, N, 1]."""
    n_agents, n_features = env.observation_spec[critic_key].shape[-2:]
    if config.shared_value:
        network: nn.Module = SharedValue(make_mlp(config, n_agents * n_features, 1, env.device))
    else:
        network = make_mlp(config, n_features, 1, env.device)
    if normalize:
        network = NormalizedValue(network, env.device)
    return TensorDictModule(network, in_keys=[critic_key], out_keys=[keys.STATE_VALUE])


class SharedValue(nn.Module):
    """One value for all UAVs of a world, from the features of all of them, [*, N G]."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, observations: Tensor) -> Tensor:
        """The value of observations [*, N, G], the same for each UAV, [*, N, 1]."""
        value = self.network(observations.flatten(-2)).unsqueeze(-2)
        return value.expand(*observations.shape[:-1], 1)


class NormalizedValue(nn.Module):
    """Values from a network whose outputs are values of mean 0 and standard deviation 1 (Yu et al. 2022)."""

    def __init__(self, network: nn.Module, device: torch.device | None) -> None:
        super().__init__()
        self.network = network
        # TorchRL's smallest variance, 1e-5, is that of rewards which are merely small.
        norm = PopArtValueNorm(beta=FORGETTING, epsilon=1e-16, device=device)
        self.norm = norm.double()  # the variance is a difference of squares

    def forward(self, observations: Tensor) -> Tensor:
        """Return the values of observations [*, N, G] in the unit of the rewards, [*, N, 1]."""
        value = self.network(observations)
        return self.norm.denormalize(value).to(value.dtype)
