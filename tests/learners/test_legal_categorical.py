"""The distribution of discrete actions, beside TorchRL's and torch's."""

import pytest
import torch
from torch import Tensor
from torch.distributions import Categorical
from torchrl.modules import MaskedCategorical

from damian.learners.networks import LegalCategorical


def both(shape: tuple[int, ...], masked: bool) -> tuple[LegalCategorical, Categorical, Tensor]:
    """Ours and the other one for random logits and legal actions, and the logits."""
    logits = (3 * torch.randn(*shape, 7)).requires_grad_()
    mask = torch.rand(*shape, 7) < 0.4
    mask[..., 2] = True
    if masked:
        return LegalCategorical(logits, mask), MaskedCategorical(logits, mask=mask, neg_inf=-1e8), logits
    return LegalCategorical(logits), Categorical(logits=logits), logits


every_shape = pytest.mark.parametrize("shape", [(50,), (5, 4, 3)])
masked_or_not = pytest.mark.parametrize("masked", [True, False])


@every_shape
@masked_or_not
def test_probabilities_and_entropies_and_their_gradients_are_those_of_other_libraries(shape, masked):
    ours, other, logits = both(shape, masked)
    actions = other.sample()
    terms = [(p.log_prob(actions), p.entropy(), p.probs) for p in (ours, other)]
    torch.testing.assert_close(*terms, rtol=1e-5, atol=1e-6)
    for one, another in zip(*terms, strict=True):
        weights = torch.rand_like(one)  # TorchRL's gradient is nan for weights above 1
        gradients = [
            torch.autograd.grad((term * weights).sum(), logits, retain_graph=True) for term in (one, another)
        ]
        torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-6)


@every_shape
@masked_or_not
def test_draws_are_those_of_other_libraries_and_always_legal(shape, masked):
    ours, other, _ = both(shape, masked)
    for sample_shape in (torch.Size([]), torch.Size([2]), torch.Size([2, 3])):
        torch.manual_seed(1)
        drawn = ours.sample(sample_shape)
        torch.manual_seed(1)
        assert drawn.equal(other.sample(sample_shape))
        assert (ours.log_prob(drawn) > -1e7).all()
    assert ours.deterministic_sample.equal(other.mode)
    illegal = ours.logits < -1e7
    assert illegal.any() == masked
    assert (ours.probs[illegal] == 0).all()
    assert len(set(ours.sample(torch.Size([50])).flatten().tolist())) == 7
