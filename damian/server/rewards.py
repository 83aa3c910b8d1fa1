"""The terms of the reward, computed from features (paper, eq. 5-8), and terms from outside the package.

``reward`` is pure and batched, as ``observe`` is. A term has the name of its feature; its weight in the
configuration and its tag in the logs have the same name.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from damian.common import checks
from damian.common.registry import Registry, check_parameters, name_of, require_parentheses
from damian.server.features import FEATURES
from damian.server.termination import Status

INDIVIDUAL = ("coverage", "spotted", "battery")
"""Terms of the individual reward (eq. 7)."""
SYSTEM = (
    "source_distance",
    "source_time",
    "source_bearing",
    "source_drift",
    "spotting_agents",
    "mean_distance",
    "mean_distance_not_spotting",
    "mean_distance_spotting",
)
"""Terms of the system reward (eq. 6)."""


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
        reads: names of the features that it reads, built-in or your own (``package.module:name``).
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
"""Reward terms from outside the package, by name or as ``package.module:name``."""


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


@dataclass
class RewardConfig:
    """The task, as weights of the reward terms (eq. 5-8). A term with weight 0 is not computed."""

    coverage: float = 0.0
    """Weight of the share of the UAV's latest footprints that is new, in the region and in no other UAV's
    footprint (w_ca of R1^a, eq. 7)."""
    spotted: float = 1.0
    """Weight of spotting the source, over the motions since the UAV last spotted it (w_k of R2^a, eq. 7)."""
    battery: float = 0.0
    """Weight of the battery level, in [0, 1] (w_b of R3^a, eq. 7)."""
    source_distance: float = 0.0
    """Weight of being near the source, as estimated from detections, over the motions since the UAV last
    spotted it (w_ds of R1^s, eq. 6)."""
    source_time: float = 0.0
    """Weight of a recent detection by any UAV (w_ts of R2^s, eq. 6)."""
    source_bearing: float = 0.0
    """Weight of a small bearing of the source, clockwise from north (w_bs of R3^s, eq. 6)."""
    source_drift: float = 0.0
    """Weight of a heading towards the source (w_th of R4^s, eq. 6); ``drift`` says how it is paid."""
    spotting_agents: float = 0.0
    """Weight of a share of spotting UAVs near ``desired_spotting`` (w_ss of R5^s, eq. 6)."""
    mean_distance: float = 0.0
    """Weight of a mean distance to the other UAVs near ``desired_distance`` (w_avg of R6^s, eq. 6)."""
    mean_distance_not_spotting: float = 0.0
    """Weight of a mean distance between UAVs that do not spot near ``desired_distance_not_spotting`` (w_nss
    of R7^s, eq. 6)."""
    mean_distance_spotting: float = 0.0
    """Weight of a mean distance of the spotting UAVs to the source near ``desired_distance_spotting`` (w_ss
    of R8^s, eq. 6)."""
    individual: float = 1.0
    """Weight of the individual reward, the terms coverage, spotted and battery (w_a, eq. 8)."""
    system: float = 1.0
    """Weight of the system reward, the terms from source_distance to mean_distance_spotting (w_s, eq. 8)."""
    drift: str = "smooth"
    """R4^s for a drift theta. ``smooth``: 1 - |2 theta - 1|; ``printed``: 2 theta up to 1/2, then
    1 - theta, as eq. 6 is printed."""
    desired_spotting: float = 1.0
    """M_ss of R5^s: desired share of the UAVs that spot the source."""
    desired_distance: float = 0.5
    """D of R6^s: desired mean distance, as a share of the region's largest vertex distance."""
    desired_distance_not_spotting: float = 0.5
    """D_nss of R7^s: desired mean distance between UAVs that do not spot, as such a share."""
    desired_distance_spotting: float = 0.1
    """D_ss of R8^s: desired mean distance of the spotting UAVs to the source, as such a share."""
    bonus: float = 0.0
    """Added to the reward of every UAV on success."""
    bonus_over_steps: bool = False
    """Divide the bonus by the elapsed steps of the episode (use case 2: 2 / steps)."""
    penalty: float = 0.0
    """Subtracted from the reward of every UAV when an episode ends without success."""
    custom: list[Any] = field(default_factory=list)
    """Your own terms (``damian.reward_term``), each as ``{term: package.module:name, weight: 0.1}`` with
    any parameters of the term beside its weight, and a ``name`` if a term appears twice."""

    def __post_init__(self) -> None:
        checks.convert_types("reward", self)
        terms = [custom_term(written, f"reward.custom[{i}]") for i, written in enumerate(self.custom)]
        self._custom = {term.name: term for term in terms}
        taken = {*INDIVIDUAL, *SYSTEM} & {*self._custom}
        once = len(self._custom) == len(self.custom) and not taken
        checks.require(
            once,
            "reward.custom",
            [term.name for term in terms],
            "must differ from each other and the built-in terms; a name does, as in {term: ..., name: low}",
        )
        for name in (*INDIVIDUAL, *SYSTEM, "individual", "system", "bonus", "penalty"):
            checks.weight(f"reward.{name}", getattr(self, name))
        checks.one_of("reward.drift", self.drift, ["smooth", "printed"])
        checks.in_range("reward.desired_spotting", self.desired_spotting, 0.0, 1.0)
        for name in ("desired_distance", "desired_distance_not_spotting", "desired_distance_spotting"):
            checks.in_range(f"reward.{name}", getattr(self, name), 0.0, 2.0)  # 1.25 in the paper's code

    def __getstate__(self) -> dict[str, Any]:
        """The settings alone, because a worker process finds the functions by their paths."""
        return {name: value for name, value in vars(self).items() if name != "_custom"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self.__post_init__()

    @property
    def terms(self) -> list[str]:
        """Names of the terms whose weight is not 0."""
        individual = [n for n in INDIVIDUAL if getattr(self, n) * self.individual != 0]
        system = [n for n in SYSTEM if getattr(self, n) * self.system != 0]
        return [*individual, *system, *(name for name in self._custom if self.weight(name) != 0)]

    @property
    def custom_terms(self) -> list[CustomTerm]:
        """The terms of ``custom`` whose weight is not 0."""
        return [self._custom[name] for name in self.terms if name in self._custom]

    @property
    def features(self) -> list[str]:
        """Names of the features that these terms read; a built-in term reads the feature of its name."""
        read = ([name] if name not in self._custom else self._custom[name].reads for name in self.terms)
        return list(dict.fromkeys(itertools.chain(*read)))

    def weight(self, name: str) -> float:
        """The weight of a term in the total reward (eq. 8)."""
        if name in self._custom:
            term = self._custom[name]
            return term.weight * (self.individual if term.scope == "individual" else self.system)
        group = self.individual if name in INDIVIDUAL else self.system
        return getattr(self, name) * group

    def value(self, name: str, features: dict[str, Tensor], counters: Counters) -> Tensor:
        """A term before it is weighted, [*, N]."""
        if name in self._custom:
            term = self._custom[name]
            value = term.compute({n: features[n] for n in term.reads}, counters, **term.parameters)
            return value.float()
        return _TERMS[name](features[name], counters, self)


def reward(features: dict[str, Tensor], counters: Counters, config: RewardConfig) -> dict[str, Tensor]:
    """Weighted reward terms by name (eq. 6 and 7); their sum is the reward (eq. 8).

    Args:
        features: as ``observe`` returns them; those of the built-in terms [*, N].
        counters: steps [*] and motions [*, N].
        config: weights of the terms.

    Returns:
        Each term whose weight is not 0, [*, N].
    """
    return {name: config.weight(name) * config.value(name, features, counters) for name in config.terms}


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
