"""Finds out whether a learner has diverged: losses and weights that are not finite, or beyond all use."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor, nn

LARGEST_WEIGHT = 1e5
"""Weights of useful networks are thousands of times smaller."""


def divergence(components: Mapping[str, Any], numbers: Mapping[str, float]) -> str | None:
    """Say which number shows that a learner has diverged; None if it has not.

    A number that is nan may only mean that nothing is known yet, as before SAC's warm-up: it counts only if
    weights are wrong too.

    Args:
        components: of the learner, by name.
        numbers: that the learner has logged, by name.
    """
    infinite = next((name for name, number in numbers.items() if math.isinf(number)), None)
    if infinite is not None:
        return f"{infinite} is {numbers[infinite]}"
    weight = _wrong_weight(components)
    unknown = next((name for name, number in numbers.items() if math.isnan(number)), None)
    return f"{unknown} is nan" if weight and unknown is not None else weight


@torch.no_grad()
def _wrong_weight(components: Mapping[str, Any]) -> str | None:
    """The first weight, or entry of an optimiser's state, that is not finite or too large."""
    tensors = [*_tensors(components)]
    if not tensors:
        return None
    largest = torch.stack([tensor.abs().amax().float().cpu() for _, tensor, _ in tensors])
    wrong = ~(largest <= torch.tensor([limit for _, _, limit in tensors]))
    if not wrong.any():
        return None
    first = int(wrong.int().argmax())
    name, _, limit = tensors[first]
    too_large = f", beyond {limit:g}" if math.isfinite(largest[first]) else ""
    return f"{name} has the value {largest[first]:.3g}{too_large}"


def _tensors(components: Mapping[str, Any]) -> Iterator[tuple[str, Tensor, float]]:
    """Weights and what optimisers remember: name, tensor, largest magnitude that is right."""
    finite = torch.finfo(torch.float32).max
    for name, component in components.items():
        if isinstance(component, nn.Module):
            for path, weights in component.named_parameters():
                if weights.is_floating_point() and weights.numel():
                    yield f"{name}: {path}", weights, LARGEST_WEIGHT
        elif isinstance(component, torch.optim.Optimizer):
            for state in component.state.values():
                for path, value in state.items():
                    if isinstance(value, Tensor) and value.is_floating_point() and value.numel():
                        yield f"{name}: {path}", value, finite
