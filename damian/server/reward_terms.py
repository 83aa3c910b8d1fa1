"""Reward terms of one's own: a function of features and counters, with parameters beside its weight."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from torch import Tensor

from damian.common import checks
from damian.common.registry import Registry, check_parameters


class Counters(NamedTuple):
    """Counts that rewards depend on besides the features."""

    steps: Tensor
    """Elapsed steps of the episode, [*]."""
    motions: Tensor
    """Motions since each UAV last spotted the source, [*, N]."""


class RewardTerm(NamedTuple):
    """A function that computes a reward term, and what it needs."""

    compute: Callable[..., Tensor]
    """From features by name, each [*, N] or [*, N, width], and counters to the term before it is weighted,
    [*, N]."""
    reads: Sequence[str]
    """Names of the features that it reads."""
    scope: str
    """``individual`` (weighted by w_a of eq. 8) or ``system`` (by w_s)."""


def reward_term(
    reads: Sequence[str], scope: str = "individual"
) -> Callable[[Callable[..., Tensor]], RewardTerm]:
    """Decorator that makes a reward term of a function.

    The function gets features by name, and ``Counters``; its keyword-only arguments are parameters that a
    configuration may set. A feature has the shape and the range that it declares: [*, N] in [0, 1] unless it
    says otherwise, and [*, N, width] if it has several values. The function returns [*, N], and must be pure,
    batched over * and, for ``env.compile()``, free of branches on data.

    Args:
        reads: names of the features that it reads, built-in or of one's own (``package.module:name``).
        scope: ``individual`` or ``system``.

    Examples:
        >>> # in lab.py, used as reward.custom=[{term: lab:low_battery, weight: -1, below: 0.5}]
        >>> @reward_term(reads=["battery"])
        ... def low_battery(features, counters, *, below=0.3):
        ...     return (features["battery"] < below).float()
    """
    return lambda compute: RewardTerm(compute, tuple(reads), scope)


def _not_a_term(found: Any) -> str | None:
    return None if isinstance(found, RewardTerm) else "is no reward term: decorate it with damian.reward_term"


REWARD_TERMS = Registry[RewardTerm]("reward term", _not_a_term)
"""Reward terms of one's own, by name or as ``package.module:name``."""


class CustomTerm(NamedTuple):
    """A reward term as a configuration uses it."""

    name: str
    """Key of the term in logs: ``name`` in the settings, or else the function's name."""
    weight: float
    """Weight of the term within its scope."""
    compute: Callable[..., Tensor]
    reads: Sequence[str]
    scope: str
    parameters: Mapping[str, Any]
    """Keyword arguments of ``compute``."""


def custom_term(written: Any) -> CustomTerm:
    """Read ``{term: package.module:name, weight: 0.1, ...}``; a ``name`` tells terms of one function apart.

    Raises:
        InputError: the term does not exist, has no such parameter, or its weight is no finite number.
    """
    key = "reward.custom"
    path, term, parameters = REWARD_TERMS.read(written, key, "term")
    weight = parameters.pop("weight", 1.0)
    finite = isinstance(weight, int | float) and math.isfinite(weight)
    checks.require(finite, f"{key}.weight", weight, f"is not a finite weight of {path}")
    name = parameters.pop("name", path.rpartition(":")[2])
    checks.require(str(name).isidentifier(), f"{key}.name", name, "is not a name of letters, digits and _")
    check_parameters(term.compute, parameters, path, key)
    return CustomTerm(name, float(weight), term.compute, term.reads, term.scope, parameters)
