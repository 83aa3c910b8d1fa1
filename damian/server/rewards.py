"""The terms of the reward, by the names of their features (paper, eq. 5-8), and terms of users."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from damian.common import checks
from damian.common.errors import InputError
from damian.common.registry import Registry, check_parameters, name_of, parameters_of
from damian.server.config import BUILT_IN, RewardConfig
from damian.server.features import FEATURES
from damian.server.termination import Status


class Counters(NamedTuple):
    """Counts that rewards depend on besides the features."""

    steps: Tensor
    """Elapsed steps of the episode, [*]."""
    motions: Tensor
    """Motions since each UAV last spotted the source, [*, N]."""
    news: Tensor
    """Whether the server has not held each UAV's message before, [*, N] bool: pay an event only
    then."""


class RewardTerm(NamedTuple):
    """A function that computes a reward term, and what it needs."""

    compute: Callable[..., Tensor]
    """From features by name and ``Counters`` to the term before it is weighted, [*, N]."""
    reads: Sequence[str]
    """Names of the features that it reads."""
    scope: str
    """``individual`` (weighted by w_a of eq. 8) or ``system`` (by w_s)."""


def reward_term(
    reads: Sequence[str], scope: str = "individual"
) -> Callable[[Callable[..., Tensor]], RewardTerm]:
    """Decorator that makes a reward term of a function.

    The function gets the features that it ``reads`` by name (built-in or ``package.module:name``),
    [*, N] or in the shape that they declare, and ``Counters``; its keyword-only arguments are
    parameters that a configuration may set. It returns [*, N], and must be pure, batched over *
    and, for ``env.compile()``, free of branches on data. Its ``scope`` is ``individual`` or
    ``system``.

    Examples:
        >>> # in lab.py, used as reward.custom=[{term: lab:low_battery, weight: -1, below: 0.5}]
        >>> @reward_term(reads=["battery"])
        ... def low_battery(features, counters, *, below=0.3):
        ...     return (features["battery"] < below).float()
    """
    checks.one_of("scope of a reward term", scope, ("individual", "system"))
    return lambda compute: RewardTerm(compute, tuple(reads), scope)


REWARD_TERMS = Registry[RewardTerm](
    "reward term", RewardTerm, "is not a reward term: decorate it with damian.reward_term"
)
"""Reward terms by name; those outside the package as ``package.module:name``."""


class WeightedTerm(NamedTuple):
    """A reward term as settings use it."""

    name: str
    weight: float
    """Weight in the total reward (eq. 8)."""
    term: RewardTerm
    parameters: Mapping[str, Any]
    """Keyword arguments of the function."""

    def value(self, features: Mapping[str, Tensor], counters: Counters) -> Tensor:
        """The term before it is weighted, [*, N]."""
        known = {name: features[name] for name in self.term.reads}
        value = self.term.compute(known, counters, **self.parameters)
        if value.shape != counters.motions.shape:  # it would be broadcast without a word
            shapes = f"{[*value.shape]} is not {[*counters.motions.shape]} (worlds, UAVs)"
            raise InputError(
                f"reward term {self.name}: shape: {shapes}: return a value for each UAV"
            )
        return value.float()


def terms_of(config: RewardConfig) -> dict[str, WeightedTerm]:
    """The terms whose weight is not 0, by name: built-in ones, then the user's own
    (``reward.custom``).

    The parameters of a built-in term are the settings of their names.
    """
    factor = {"individual": config.individual, "system": config.system}
    found = {}
    for name in BUILT_IN:
        if weight := getattr(config, name):
            term = REWARD_TERMS.get(name, f"reward.{name}")
            settings = {each: getattr(config, each) for each in parameters_of(term.compute)}
            found[name] = WeightedTerm(name, weight * factor[term.scope], term, settings)
    for number, written in enumerate(config.custom):
        key = f"reward.custom[{number}]"
        path, term, parameters = REWARD_TERMS.read(written, key, "term")
        for read in term.reads:
            FEATURES.get(read, f"{key}.term: reads of {path}")
        weight = parameters.pop("weight", 1.0)
        checks.in_range(f"{key}.weight", weight, -1e6, 1e6)
        name = name_of(parameters, path.rpartition(":")[2], key)
        check_parameters(term.compute, parameters, path, key)
        checks.require(
            name not in (*BUILT_IN, *found),
            f"{key}.name",
            name,
            f"is the name of another term: give it another one, as in {{term: {path}, name: other}}",
        )
        if weight != 0:
            found[name] = WeightedTerm(name, weight * factor[term.scope], term, parameters)
    return found


def reward(
    features: Mapping[str, Tensor], counters: Counters, terms: Mapping[str, WeightedTerm]
) -> dict[str, Tensor]:
    """Weighted reward terms by name, [*, N] (eq. 6 and 7); their sum is the reward (eq. 8)."""
    return {name: each.weight * each.value(features, counters) for name, each in terms.items()}


def final_reward(ended: Status, counters: Counters, config: RewardConfig) -> Tensor:
    """Bonus on success, penalty at any other end, the same for every UAV, [*]."""
    bonus = config.bonus / counters.steps.clamp(min=1) if config.bonus_over_steps else config.bonus
    failure = (ended.terminated | ended.truncated) & ~ended.success
    return ended.success * bonus - failure * config.penalty


# The terms of the paper. Each reads the feature of its name.


def _per_motion(value: Tensor, counters: Counters) -> Tensor:
    return value / counters.motions.clamp(min=1)


def _straight(turn: Tensor, drift: str) -> Tensor:
    """R4^s, from the feature ``source_drift``; it is largest at 1/2, for a UAV that flies at the
    source."""
    if drift == "printed":
        return torch.where(turn <= 0.5, 2 * turn, 1 - turn)
    return 1 - (2 * turn - 1).abs()


def _near(value: Tensor, desired: float) -> Tensor:
    return 1 - (desired - value).abs()


def _add(name: str, scope: str, compute: Callable[..., Tensor]) -> None:
    """Register the term of a feature: ``compute(value, counters, **parameters)``."""

    @functools.wraps(compute)
    def term(features: Mapping[str, Tensor], counters: Counters, **parameters: Any) -> Tensor:
        return compute(features[name], counters, **parameters)

    REWARD_TERMS.register(name)(reward_term([name], scope)(term))


_add("coverage", "individual", lambda x, counters: x)
_add("spotted", "individual", _per_motion)
_add("battery", "individual", lambda x, counters: x)
_add("served", "individual", lambda x, counters: x * counters.news)
_add("source_distance", "system", lambda x, counters: _per_motion(1 - x, counters))
_add("source_time", "system", lambda x, counters: 1 - x)
_add("source_bearing", "system", lambda x, counters: 1 - x)
_add("source_drift", "system", lambda x, counters, *, drift: _straight(x, drift))
_add(
    "spotting_agents", "system", lambda x, counters, *, desired_spotting: _near(x, desired_spotting)
)
_add("mean_distance", "system", lambda x, counters, *, desired_distance: _near(x, desired_distance))
_add(
    "mean_distance_not_spotting",
    "system",
    lambda x, counters, *, desired_distance_not_spotting: _near(x, desired_distance_not_spotting),
)
_add(
    "mean_distance_spotting",
    "system",
    lambda x, counters, *, desired_distance_spotting: _near(x, desired_distance_spotting),
)
