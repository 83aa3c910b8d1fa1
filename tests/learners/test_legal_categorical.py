"""The distribution of discrete actions, beside TorchRL's and torch's."""

import math

import pytest
import torch
from torch.distributions import Categorical
from torchrl.modules import MaskedCategorical

from damian.models.distribution import LegalCategorical


def both(shape, masked):
    """Ours and the other one for random logits and legal actions, and the logits."""
    logits = (3 * torch.randn(*shape, 7)).requires_grad_()
    mask = torch.rand(*shape, 7) < 0.4
    mask[..., 2] = True
    if masked:
        return (
            LegalCategorical(logits, mask),
            MaskedCategorical(logits, mask=mask, neg_inf=-1e8),
            logits,
        )
    return LegalCategorical(logits), Categorical(logits=logits), logits


every_shape = pytest.mark.parametrize(
    "shape",
    [
        (50,),
        (5, 4, 3),
    ],
)
masked_or_not = pytest.mark.parametrize("masked", [True, False])


@every_shape
@masked_or_not
def test_probabilities_and_entropies_and_their_gradients_are_those_of_other_libraries(
    shape, masked
):
    ours, other, logits = both(shape, masked)
    actions = other.sample()
    terms = [(p.log_prob(actions), p.entropy(), p.probs) for p in (ours, other)]
    torch.testing.assert_close(*terms, rtol=1e-5, atol=1e-6)
    for one, another in zip(*terms, strict=True):
        weights = torch.rand_like(one)  # TorchRL's gradient is nan for weights above 1
        gradients = [
            torch.autograd.grad((term * weights).sum(), logits, retain_graph=True)
            for term in (one, another)
        ]
        torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-6)


@every_shape
@masked_or_not
def test_draws_are_legal_and_as_frequent_as_probable(shape, masked):
    torch.manual_seed(1)
    ours, other, _ = both(shape, masked)
    n_draws = 20_000
    drawn = ours.sample(torch.Size([2, n_draws // 2]))
    assert drawn.shape == (2, n_draws // 2, *shape)
    assert ours.sample().shape == shape
    frequency = torch.nn.functional.one_hot(drawn, 7).float().mean((0, 1))
    error = (ours.probs * (1 - ours.probs) / n_draws).sqrt()
    assert (
        (frequency - ours.probs).abs() <= 5 * error
    ).all()  # none of an illegal action, whose error is 0
    assert ours.deterministic_sample.equal(other.mode)
    illegal = ours.logits < -1e7
    assert illegal.any() == masked
    assert (ours.probs[illegal] == 0).all()


@pytest.mark.parametrize("low", [-1e9, -1e30, -torch.inf])
def test_however_low_the_logits_are_draws_are_legal_and_entropies_finite(low):
    logits = (
        torch.tensor([[low, low, 0.0, 1.0], [0.0, low, low, low]]).repeat(500, 1).requires_grad_()
    )
    mask = torch.tensor([[True, True, False, False], [True, True, False, False]]).repeat(500, 1)
    distribution = LegalCategorical(logits, mask)
    first, second = distribution.probs.view(500, 2, 4)[0]
    assert first.tolist() == [0.5, 0.5, 0.0, 0.0]
    assert second.tolist() == [1.0, 0.0, 0.0, 0.0]
    assert mask.gather(-1, distribution.sample().unsqueeze(-1)).all()
    entropy = distribution.entropy().view(500, 2)[0]
    torch.testing.assert_close(entropy, torch.tensor([math.log(2), 0.0]))
    entropy.sum().backward()
    assert logits.grad.isfinite().all()


@pytest.mark.parametrize("n_legal", [1, 2, 7])
def test_the_ends_of_the_unit_interval_draw_legal_actions(monkeypatch, n_legal):
    logits = torch.randn(1000, 7)
    mask = torch.zeros(1000, 7).bool()
    first = torch.randint(8 - n_legal, (1000, 1))
    mask.scatter_(-1, first + torch.arange(n_legal), True)
    distribution = LegalCategorical(logits, mask)
    for end, expected in ((0.0, first), (1 - 2**-24, first + n_legal - 1)):
        monkeypatch.setattr(torch, "rand", lambda *shape, end=end, **_: torch.full(shape, end))
        assert distribution.sample().equal(expected.squeeze(-1))
