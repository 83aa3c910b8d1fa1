"""A learner has diverged if a weight is not finite or beyond all use, or a logged number is infinite."""

import math

import torch
from torch import nn

from damian.learners.base import divergence


def test_a_nan_counts_only_if_weights_are_wrong():
    network = nn.Linear(2, 2)
    components = {"actor": network, "optimizer": torch.optim.Adam(network.parameters()), "other": nn.ReLU()}
    assert divergence(components, {"loss": 1.0, "not known yet": math.nan}) is None
    assert divergence(components, {"a": 1.0, "b": -math.inf}) == "b is -inf"
    for value in (math.nan, -2e5):
        with torch.no_grad():
            network.bias[1] = value
        found = divergence(components, {})
        assert found == f"a weight of actor is {abs(value):.3g}, not at most 100000"
