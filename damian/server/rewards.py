"""The terms of the reward, by the names of their features (paper, eq. 5-8), and terms of users."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from damian.common import checks
from damian.common.registry import Registry, check_parameters, name_of
from damian.server.config import INDIVIDUAL, SYSTEM, RewardConfig
from damian.server.features import FEATURES
from damian.server.termination import Status


class Counters(NamedTuple):
    """Counts that rewards depend on besides the features."""

    steps: Tensor
    """Elapsed steps of the episode, [*]."""
    motions: Tensor
    """Motions since each UAV last spotted the source, [*, N]."""


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

    The function gets the features that it ``reads`` by name (built-in or ``package.module:name``), [*, N] or
    in the shape that they declare, and ``Counters``; its keyword-only arguments are parameters that a
    configuration may set. It returns [*, N], and must be pure, batched over * and, for ``env.compile()``,
    free of branches on data. Its ``scope`` is ``individual`` or ``system``.

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
"""Reward terms from outside the package, by name or as ``package.module:name``."""


class CustomTerm(NamedTuple):
    """A reward term as a configuration uses it."""

    name: str
    """Key of the term in logs: ``name`` in the settings, or else the function's name."""
    weight: float
    """Weight of the term within its scope."""
    term: RewardTerm
    parameters: Mapping[str, Any]
    """Keyword arguments of the function."""


def custom_term(written: Any, key: str) -> CustomTerm:
    """Read ``{term: package.module:name, weight: 0.1, ...}``; ``name`` tells terms of one function apart."""
    path, term, parameters = REWARD_TERMS.read(written, key, "term")
    for read in term.reads:
        FEATURES.get(read, f"{key}.term: reads of {path}")
    weight = parameters.pop("weight", 1.0)
    checks.in_range(f"{key}.weight", weight, -1e6, 1e6)
    name = name_of(parameters, path.rpartition(":")[2], key)
    check_parameters(term.compute, parameters, path, key)
    return CustomTerm(name, float(weight), term, parameters)


def own_terms(config: RewardConfig) -> dict[str, CustomTerm]:
    """The user's own terms by name, read once from the settings."""
    found: dict[str, CustomTerm] | None = getattr(config, "_own_terms", None)
    if found is None:
        terms = [custom_term(written, f"reward.custom[{i}]") for i, written in enumerate(config.custom)]
        found = {term.name: term for term in terms}
        names, problem = [term.name for term in terms], "must differ from each other and the built-in terms"
        once = len(found) == len(terms) and not {*INDIVIDUAL, *SYSTEM} & {*found}
        remedy = "; a name does, as in {term: ..., name: low}"
        checks.require(once, "reward.custom", names, problem + remedy)
        config._own_terms = found  # type: ignore[attr-defined]
    return found


def features_read(config: RewardConfig) -> list[str]:
    """Names of the features that the terms read; a built-in term reads the feature of its name."""
    own = own_terms(config)
    reads = [own[name].term.reads if name in own else [name] for name in config.terms]
    return list(dict.fromkeys(itertools.chain(*reads)))


def weight_of(config: RewardConfig, name: str) -> float:
    """The weight of a term in the total reward (eq. 8)."""
    if own := own_terms(config).get(name):
        return own.weight * (config.individual if own.term.scope == "individual" else config.system)
    group = config.individual if name in INDIVIDUAL else config.system
    return getattr(config, name) * group


def value_of(config: RewardConfig, name: str, features: dict[str, Tensor], counters: Counters) -> Tensor:
    """A term before it is weighted, [*, N]."""
    if own := own_terms(config).get(name):
        value = own.term.compute({n: features[n] for n in own.term.reads}, counters, **own.parameters)
        return value.float().view_as(counters.motions)  # another shape would be broadcast without a word
    return _TERMS[name](features[name], counters, config)


def reward(features: dict[str, Tensor], counters: Counters, config: RewardConfig) -> dict[str, Tensor]:
    """Weighted reward terms by name, [*, N] (eq. 6 and 7); their sum is the reward (eq. 8)."""
    return {
        name: weight_of(config, name) * value_of(config, name, features, counters) for name in config.terms
    }


def final_reward(ended: Status, counters: Counters, config: RewardConfig) -> Tensor:
    """Bonus on success, penalty at any other end, the same for every UAV, [*]."""
    bonus = config.bonus / counters.steps.clamp(min=1) if config.bonus_over_steps else config.bonus
    failure = (ended.terminated | ended.truncated) & ~ended.success
    return ended.success * bonus - failure * config.penalty


def _per_motion(value: Tensor, counters: Counters) -> Tensor:
    return value / counters.motions.clamp(min=1)


def _drift(theta: Tensor, config: RewardConfig) -> Tensor:
    if config.drift == "printed":
        return torch.where(theta <= 0.5, 2 * theta, 1 - theta)
    return 1 - (2 * theta - 1).abs()


def _near(desired: str) -> Callable[[Tensor, Counters, RewardConfig], Tensor]:
    return lambda value, _, config: 1 - (getattr(config, desired) - value).abs()


_TERMS: dict[str, Callable[[Tensor, Counters, RewardConfig], Tensor]] = {
    "coverage": lambda value, *_: value,
    "spotted": lambda value, counters, _: _per_motion(value, counters),
    "battery": lambda value, *_: value,
    "source_distance": lambda value, counters, _: _per_motion(1 - value, counters),
    "source_time": lambda value, *_: 1 - value,
    "source_bearing": lambda value, *_: 1 - value,
    "source_drift": lambda value, _, config: _drift(value, config),
    "spotting_agents": _near("desired_spotting"),
    "mean_distance": _near("desired_distance"),
    "mean_distance_not_spotting": _near("desired_distance_not_spotting"),
    "mean_distance_spotting": _near("desired_distance_spotting"),
}
