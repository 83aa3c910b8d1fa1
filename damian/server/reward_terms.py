"""Reward terms of one's own: a function of features and counters, with parameters beside its weight."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from torch import Tensor

from damian.common import checks
from damian.common.registry import Registry, check_parameters, name_of, require_parentheses
from damian.server.features import FEATURES


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

    Raises:
        InputError: ``reads`` is no list, there is no such scope, or the decorator has no parentheses.

    Examples:
        >>> # in lab.py, used as reward.custom=[{term: lab:low_battery, weight: -1, below: 0.5}]
        >>> @reward_term(reads=["battery"])
        ... def low_battery(features, counters, *, below=0.3):
        ...     return (features["battery"] < below).float()
    """
    require_parentheses(reads, "@damian.reward_term(reads=[...])")
    problem = f"is not a list of names: write reads=[{reads!r}]"
    checks.require(not isinstance(reads, str), "reads of a reward term", reads, problem)
    checks.one_of("scope of a reward term", scope, ("individual", "system"))
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


def custom_term(written: Any, key: str) -> CustomTerm:
    """Read ``{term: package.module:name, weight: 0.1, ...}``; a ``name`` tells terms of one function apart.

    Args:
        written: what the configuration says.
        key: of the setting, for errors.

    Raises:
        InputError: the term or a feature that it reads does not exist, it has no such parameter, or its
            weight is no finite number.
    """
    path, term, parameters = REWARD_TERMS.read(written, key, "term")
    for read in term.reads:
        FEATURES.get(read, f"{key}.term: reads of {path}")
    weight = parameters.pop("weight", 1.0)
    checks.weight(f"{key}.weight", weight)
    name = name_of(parameters, path.rpartition(":")[2], key)
    check_parameters(term.compute, parameters, path, key)
    return CustomTerm(name, float(weight), term.compute, term.reads, term.scope, parameters)
