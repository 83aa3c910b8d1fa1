"""Initial weights of the networks: PyTorch's, or orthogonal ones."""

import math

import torch
from helpers import both_kinds, everything
from torch import Tensor, nn

from damian.envs.uav_env import UavEnv
from damian.learners.networks import ModelConfig, make_actor, make_critic


def gains(weights: Tensor) -> Tensor:
    """Singular values of matrices [*, n, m]: all of them equal the gain if the weights are orthogonal."""
    return torch.linalg.svdvals(weights.detach())


def check_gains(network: nn.Module, expected: list[float]) -> None:
    """Assert that each matrix of a network has the expected gain, and each vector is 0."""
    matrices = [each for each in network.parameters() if each.ndim == 2]
    vectors = [each for each in network.parameters() if each.ndim == 1]
    assert len(matrices) == len(expected) == len(vectors)
    for weights, gain in zip(matrices, expected, strict=True):
        torch.testing.assert_close(gains(weights), torch.full([min(weights.shape)], gain))
    assert all((each == 0).all() for each in vectors)


@both_kinds
def test_orthogonal_weights_have_a_gain_by_the_place_of_their_layer(kind):
    config, hidden = ModelConfig(hidden=[16, 8], init="orthogonal"), math.sqrt(2)
    env = UavEnv(everything(kind=kind), 2)
    check_gains(make_actor(env, config), [hidden, hidden, 0.01])
    for shared, normalize in ((False, False), (True, True)):
        config.shared_value = shared
        check_gains(make_critic(env, config, normalize=normalize), [hidden, hidden, 1.0])
