"""How a setting is declared: its default, meaning, bounds and choices stand in one place, its field.

Every dataclass of settings derives from ``Settings``, which checks all of its fields when it is made. Checks
between two settings stand in ``__post_init__`` of the dataclass that has both. Nothing here imports torch, so
that a misspelt setting and a question for help are answered at once.
"""

import dataclasses
import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import UnionType
from typing import Any, ClassVar, TypeGuard, Union, cast, get_args, get_origin, get_type_hints

from damian.common import checks
from damian.common.errors import InputError


@dataclass(frozen=True)
class Rule:
    """What a field declares beside its type and default."""

    meaning: str = ""
    low: float | None = None
    """Smallest value."""
    high: float | None = None
    """Largest value; that of the unit (``checks.LARGEST``) if not given."""
    above: float | None = None
    """The value must be greater than this."""
    unit: str = ""
    choices: Sequence[Any] = ()
    """Allowed values; with ``paths`` also components of the user's own, ``package.module:Name``."""
    paths: bool = False
    kinds: tuple[str, ...] = ()
    """Kinds of the section that read this setting; all of them if empty. Another kind does not have it."""
    fixed: bool = False
    """A constant: no key of the command line or of a file, but Python programs may set it."""


def setting(
    default: Any,
    meaning: str = "",
    *,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    unit: str = "",
    choices: Sequence[Any] = (),
    paths: bool = False,
    kinds: tuple[str, ...] = (),
    fixed: bool = False,
) -> Any:
    """A field of a dataclass of settings; the arguments are those of ``Rule``.

    Args:
        default: the default value; a list or dataclass is copied for every instance.
        meaning: what the setting does, with its unit, for ``--help`` and the documentation.
    """
    rule = Rule(meaning, low, high, above, unit, choices, paths, kinds, fixed)
    if isinstance(default, type):
        return field(default_factory=default, metadata={"rule": rule})
    if isinstance(default, list | dict):
        return field(default_factory=lambda: type(default)(default), metadata={"rule": rule})
    return field(default=default, metadata={"rule": rule})


def constant(default: Any, reason: str, **bounds: Any) -> Any:
    """A field that is no key: a Python program may set it, but nobody needs to, for the reason given."""
    return setting(default, reason, fixed=True, **bounds)


@dataclass
class Settings:
    """Base of all dataclasses of settings: checks types, bounds and choices of its fields."""

    section: ClassVar[str] = ""
    """Key of these settings in those of a run, such as ``region``; empty at the top."""

    def __post_init__(self) -> None:
        hints = _hints(type(self))
        for name, rule in rules(type(self)).items():
            key = f"{self.section}.{name}".lstrip(".")
            value = _converted(key, getattr(self, name), hints[name])
            setattr(self, name, value)
            if value is not None:
                _check_value(key, value, rule, _base(hints[name]))

    def __getstate__(self) -> dict[str, Any]:
        """The settings alone, because what other modules have read from them may not be copied."""
        return {each.name: getattr(self, each.name) for each in dataclasses.fields(self)}

    @property
    def variant(self) -> str:
        """The kind of this section, which decides what of it is read; empty if there is none."""
        return str(getattr(self, "kind", ""))

    def refuse_unread(self) -> None:
        """Refuse settings that only other kinds of this section read, if they were changed.

        A kind of the user's own, ``package.module:Name``, may read any of them.
        """
        kind = self.variant
        if ":" in kind:
            return
        for each in dataclasses.fields(self):
            kinds, value = rules(type(self))[each.name].kinds, getattr(self, each.name)
            problem = f"means nothing with {self.section}={kind}: only {' or '.join(kinds)} reads it"
            read = not kinds or kind in kinds or value == default_of(each)
            checks.require(read, f"{self.section}.{each.name}", value, problem)


def default_of(each: "dataclasses.Field[Any]") -> Any:
    """The default value of a field; ``MISSING`` of dataclasses if it has none."""
    made = each.default_factory is not dataclasses.MISSING
    return each.default_factory() if made else each.default  # type: ignore[misc]


@functools.cache
def rules(kind: type) -> dict[str, Rule]:
    """The rules of the fields of a dataclass; a field that only changes the default keeps the rule."""
    found: dict[str, Rule] = {}
    for base in reversed(kind.__mro__):
        for each in getattr(base, "__dataclass_fields__", {}).values():
            if "rule" in each.metadata or each.name not in found:
                found[each.name] = each.metadata.get("rule", Rule())
    return {each.name: found[each.name] for each in dataclasses.fields(kind)}


def leaves(config: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every setting of nested dataclasses by its key, without constants and what its kind does not read."""
    kind = config.variant if isinstance(config, Settings) else ""
    for name, rule in rules(type(config)).items():
        value = getattr(config, name)
        if dataclasses.is_dataclass(value):
            yield from leaves(value, f"{path}{name}.")
        elif not rule.fixed and (":" in kind or not rule.kinds or kind in rule.kinds):
            yield f"{path}{name}", value


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _base(hint: Any) -> Any:
    """A type without ``| None``."""
    if get_origin(hint) in (UnionType, Union):
        return next(each for each in get_args(hint) if each is not type(None))
    return hint


_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text", list: "a list"}
_KINDS |= {dict: "a mapping such as {name: value}"}


def _converted(key: str, value: Any, hint: Any) -> Any:
    """A value of the declared type; arrays and numbers of NumPy and torch become plain ones.

    Raises:
        InputError: the value has another type.
    """
    value, kind = plain(value), _base(hint)
    if kind is Any or (value is None and type(None) in get_args(hint)):
        return value
    origin, inner = get_origin(kind) or kind, get_args(kind)
    if origin is float and is_number(value):
        return value
    if origin is str and is_number(value):
        return str(value)  # a time such as 2
    good = isinstance(value, origin) and not (isinstance(value, bool) and origin is not bool)
    article = _KINDS.get(origin, f"a {getattr(origin, '__name__', origin)}")
    checks.require(good, key, value, f"is not {article}")
    if origin is list and inner:
        return [_converted(key, each, inner[0]) for each in cast(Sequence[Any], value)]
    return value


def _check_value(key: str, value: Any, rule: Rule, kind: Any) -> None:
    """Check one value, or each one of a list, against its rule."""
    if isinstance(value, list) and kind is not Any:
        inner = next(iter(get_args(kind)), Any)
        for each in value:
            _check_value(key, each, rule, inner)
        return
    if rule.choices and not (rule.paths and ":" in str(value)):
        checks.one_of(key, value, rule.choices)
    if kind in (int, float) and is_number(value):
        _check_number(key, value, rule)


def _check_number(key: str, value: float, rule: Rule) -> None:
    """Check a number against its bounds, or else the largest number of its unit."""
    if rule.above is not None:
        checks.above(key, value, rule.above, rule.unit)
    if rule.low is None and rule.high is None:
        most = checks.LARGEST.get(rule.unit, checks.HUGE)
        checks.in_range(key, value, -most, most, rule.unit)
    else:
        checks.in_range(key, value, -math.inf if rule.low is None else rule.low, rule.high, rule.unit)


def plain(value: Any) -> Any:
    """A value with Python's own lists and numbers instead of those of NumPy and torch."""
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(each) for each in value] if type(value) in (list, tuple) else value


def is_number(value: Any) -> TypeGuard[float]:
    """Is a value a number, and neither true nor false?"""
    return isinstance(value, int | float) and not isinstance(value, bool)


def check_place(key: str, place: Any) -> None:
    """Require ``[x, y]`` of two finite numbers [m], or ``{lat: ..., lon: ...}`` in range [deg].

    Raises:
        InputError: it is something else.
    """
    if not isinstance(place, Mapping):
        good = isinstance(place, Sequence) and len(place) == 2 and all(map(is_number, place))
        checks.require(good, key, place, "is not [x, y] in metres or {lat: ..., lon: ...} in degrees")
        checks.place(key, place)
        return
    if set(place) != {"lat", "lon"}:
        raise InputError(
            f"{key}: {place} is not {{lat: ..., lon: ...}} in degrees, such as {{lat: 53.1, lon: -4.5}}"
        )
    checks.in_range(f"{key}.lat", place["lat"], -90.0, 90.0, "deg")
    checks.in_range(f"{key}.lon", place["lon"], -180.0, 180.0, "deg")
