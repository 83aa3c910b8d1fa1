"""From a network's outputs to actions."""

from collections.abc import Callable, Sequence
from typing import cast

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor
from torch.distributions import Distribution
from torchrl.data import Bounded, Categorical
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor, TanhNormal

from damian import keys


class LegalCategorical(Distribution):
    """Categorical distribution of logits [*, A] over legal actions; TorchRL's takes four times as
    long.

    Actions are drawn by the inverse of the cumulative distribution, in a third of the time of
    ``torch.multinomial``.
    """

    def __init__(self, logits: Tensor, mask: Tensor | None = None) -> None:
        lowest = torch.finfo(logits.dtype).min
        logits = logits.clamp(min=lowest / 4)  # finite, so that an entropy is
        if mask is not None:
            logits = logits.masked_fill(
                ~mask, lowest / 2
            )  # far below all legal ones, whatever these are
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
        # Below the last sum even after rounding; an action of probability 0 adds nothing to the one
        # before.
        return (cumulative <= drawn * cumulative[..., -1:]).sum(-1)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability of actions [*sample_shape, *], finite but very low where they are
        illegal."""
        logits = self.logits.expand(*value.shape, -1)
        return logits.gather(-1, value.unsqueeze(-1)).squeeze(-1)

    def entropy(self) -> Tensor:
        """Entropy, [*]."""
        return -(self.probs * self.logits).sum(-1)


def with_distribution(
    env: EnvBase, make_network: Callable[..., TensorDictModule]
) -> ProbabilisticActor:
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
