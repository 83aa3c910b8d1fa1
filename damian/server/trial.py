"""Features and reward terms of one's own, each tried once when an environment is built."""

import torch
from torch import Tensor

from damian.common import checks
from damian.common.errors import Declared, naming_errors
from damian.common.tensors import tree_map
from damian.server.feature_cache import FeatureCache, ServerContext
from damian.server.features import FEATURES, Feature
from damian.server.reward_terms import Counters, CustomTerm
from damian.world.messages import Messages
from damian.world.uav_values import check_uav_values

_TRIED = 32
"""Number of initial conditions with which a local feature is tried."""


def try_feature(name: str, messages: Messages, context: ServerContext) -> None:
    """Try a feature of one's own; a built-in one is left alone.

    Args:
        name: of the feature.
        messages: first messages of Q initial conditions, [Q, N].
        context: of these messages.

    Raises:
        InputError: it raises an error, its values are not finite, or have another shape or range than it
            declares, or it is local, but depends on other messages than the UAV's own.
    """
    if ":" not in name:
        return
    found, key = FEATURES.get(name, "feature"), f"feature {name}"
    with naming_errors(key):
        values = found.compute(FeatureCache(messages, context))
    check_uav_values(key, values, messages.track.shape, found.width, f", as width={found.width} asks for")
    slack = 1e-5 * (found.high - found.low)
    beyond = values[(values < found.low - slack) | (values > found.high + slack)][:1].tolist()
    problem = f"lies outside of low={found.low:g} and high={found.high:g}, which it declares"
    checks.require(not beyond, key, beyond, problem)
    if found.scope == "local":
        depends = _depends_on_others(found, messages, context)
        problem = "but depends on the messages of other UAVs: make it global, or read only the UAV's own"
        checks.require(not depends, key, "is local,", problem)


def _depends_on_others(found: Feature, messages: Messages, context: ServerContext) -> bool:
    """Does the value of UAV i change if every UAV has the message of UAV i?"""
    n = min(_TRIED, len(context.now))
    context = context._replace(now=context.now[:n] + context.time_scale, scale=context.scale[:n])
    varied = _varied(tree_map(lambda field: field[:n], messages), context)
    try:
        expected = found.compute(FeatureCache(varied, context)).float()
        for i in range(varied.track.shape[1]):
            alike = tree_map(lambda field, i=i: field[:, i : i + 1].expand_as(field), varied)
            own = found.compute(FeatureCache(alike, context)).float()
            if not torch.allclose(own[:, i], expected[:, i], 1e-4, 1e-4, equal_nan=True):
                return True
    except Exception:  # it need not cope with messages as random as these
        return False
    return False


def _varied(messages: Messages, context: ServerContext) -> Messages:
    """Messages [Q, N] of UAVs about which everything differs, as after some steps."""
    generator = torch.Generator().manual_seed(0)

    def noise(field: Tensor, scale: Tensor | float) -> Tensor:
        return scale * torch.rand(field.shape, generator=generator).to(field.device)

    metres = 0.1 * context.scale[:, None, None]
    return messages._replace(
        time=noise(messages.time, context.time_scale),
        position=messages.position + noise(messages.position, metres),
        target=messages.target + noise(messages.target, metres),
        track=noise(messages.track, 2 * torch.pi),
        battery=noise(messages.battery, 100.0),
        spotted=noise(messages.track, 1.0) > 0.5,
        motions=noise(messages.track, 5.0).long(),
        detected_time=noise(messages.time, context.time_scale),
        detected_position=messages.position + noise(messages.position, metres),
        readings=messages.readings + noise(messages.readings, 1.0),
    )


def try_term(term: CustomTerm, features: dict[str, Tensor], counters: Counters) -> None:
    """Try a reward term of one's own.

    Args:
        term: with its parameters.
        features: by name, [Q, N] or [Q, N, width].
        counters: of Q initial conditions.

    Raises:
        InputError: it raises an error, reads a feature that it does not declare, or does not return a finite
            value for each UAV.
    """
    key = f"reward term {term.name}"
    problem = f"{key}: it reads the feature NAME, which is missing from its reads={list(term.reads)}"
    declared = Declared({name: features[name] for name in term.reads}, problem)
    with naming_errors(key):
        values = term.compute(declared, counters, **term.parameters)
    check_uav_values(key, values, counters.motions.shape)
