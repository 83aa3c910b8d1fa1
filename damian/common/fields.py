"""How a setting is declared: its default, meaning, bounds and choices stand in one place, its
field.

Every dataclass of settings derives from ``Settings``, which checks its fields when it is made; a
class checks in ``__post_init__`` only what its settings exclude in each other. Nothing here imports
torch.
"""

import dataclasses
import difflib
import functools
import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from types import UnionType
from typing import Any, ClassVar, TypeVar, Union, get_args, get_origin, get_type_hints

from damian.common import checks
from damian.common.errors import InputError

S = TypeVar("S", bound="Settings")


@dataclass(frozen=True)
class Rule:
    """What a field declares beside its type and default."""

    meaning: str = ""
    """One sentence; ``setting`` puts the unit at its end: ``Longest flight [m].``"""
    low: float | None = None
    """Smallest value."""
    high: float | None = None
    """Largest value; that of the unit (``checks.LARGEST``) if not given."""
    above: float | None = None
    """The value must be greater than this."""
    choices: tuple[Any, ...] = ()
    """Allowed values; with ``paths`` also components of the user's own, ``package.module:Name``."""
    paths: bool = False
    kinds: tuple[str, ...] = ()
    """Kinds of the section that read this setting; all of them if empty. Another kind does not have
    it."""
    each: bool = False
    """A list gives one value for each UAV."""
    fixed: bool = False
    """A constant: no key of the command line or of a file, but Python programs may set it."""
    unit: str = ""
    """Unit, such as ``m/s``."""


def setting(default: Any, meaning: str = "", unit: str = "", **rule: Any) -> Any:
    """A field of settings: its default, copied for every instance, and the fields of its
    ``Rule``."""
    shown = f"{meaning.removesuffix('.')} [{unit}]." if meaning and unit else meaning
    metadata = {"rule": Rule(shown, unit=unit, **rule)}
    if isinstance(default, type):
        return field(default_factory=default, metadata=metadata)
    if isinstance(default, list | dict):
        return field(default_factory=lambda: type(default)(default), metadata=metadata)
    return field(default=default, metadata=metadata)


chance = functools.partial(setting, low=0, high=1)
"""A field between 0 and 1."""
metres = functools.partial(setting, unit="m", above=0)
"""A field that is a distance above 0."""


def constant(default: Any, reason: str, **rule: Any) -> Any:
    """A field that is no key: a Python program may set it, but nobody needs to, for the reason
    given."""
    return setting(default, reason, fixed=True, **rule)


@dataclass
class Settings:
    """Base of all dataclasses of settings: checks types, bounds and choices of its fields."""

    section: ClassVar[str] = ""
    """Key of these settings in those of a run, such as ``region``; empty at the top."""

    def __post_init__(self) -> None:
        for name in rules(type(self)):
            setattr(self, name, self.checked(name, getattr(self, name)))

    def checked(self, name: str, value: Any) -> Any:
        """A value of a field in its declared type, if it is within the bounds of the field."""
        hint = _hints(type(self))[name]
        if rules(type(self))[name].each and isinstance(plain(value), list):
            return [self.checked(name, each) for each in plain(value)]
        value = _converted(self.key(name), value, hint)
        if value is not None:
            _check_value(self.key(name), value, rules(type(self))[name], _base(hint))
        return value

    @property
    def variant(self) -> str:
        """The kind of this section, which decides what of it is read; empty if there is none."""
        return str(getattr(self, "kind", ""))

    @classmethod
    def class_for(cls, values: Mapping[str, Any]) -> "type[Settings]":
        """The class that plain values of this section make; one with a class for each option finds
        it."""
        return cls

    def key(self, name: str) -> str:
        """The key of a field on the command line."""
        return f"{self.section}.{name}".lstrip(".")

    def refuse(self, wrong: Any, name: str, problem: str) -> None:
        """Refuse a setting, or one of a section such as ``observation.own``, in a case that is
        wrong."""
        if wrong:
            value = functools.reduce(getattr, name.split("."), self)
            checks.require(
                False, self.key(name), "it" if value in (None, "", [], {}) else value, problem
            )

    def refuse_unread(self) -> None:
        """Refuse changed settings that only other kinds of the section read; your own kind reads
        any."""
        for each in dataclasses.fields(self):
            kinds = rules(type(self))[each.name].kinds
            read = not kinds or self.variant in kinds or ":" in self.variant
            self.refuse(
                not read and getattr(self, each.name) != default_of(each),
                each.name,
                f"means nothing with {self.section}={self.variant}: only {' or '.join(kinds)} "
                "reads it",
            )


def default_of(each: "dataclasses.Field[Any]") -> Any:
    """The default value of a field; ``MISSING`` of dataclasses if it has none."""
    made = each.default_factory is not dataclasses.MISSING
    return each.default_factory() if made else each.default  # type: ignore[misc]


@functools.cache
def rules(kind: type) -> dict[str, Rule]:
    """The rules of the fields of a dataclass; a field that only changes the default keeps the
    rule."""
    found = {}
    for base in reversed(kind.__mro__):
        for each in getattr(base, "__dataclass_fields__", {}).values():
            if "rule" in each.metadata or each.name not in found:
                found[each.name] = each.metadata.get("rule", Rule())
    return {each.name: found[each.name] for each in dataclasses.fields(kind)}


def leaves(config: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every setting of nested dataclasses by its key, without constants and what its kind does not
    read."""
    kind = config.variant if isinstance(config, Settings) else ""
    for name, rule in rules(type(config)).items():
        value = getattr(config, name)
        if dataclasses.is_dataclass(value):
            yield from leaves(value, f"{path}{name}.")
        elif not rule.fixed and (":" in kind or not rule.kinds or kind in rule.kinds):
            yield f"{path}{name}", value


def nested(config: Any) -> dict[str, Any]:
    """Settings as plain data, a mapping for each section, without what ``leaves`` leaves out."""
    found = {}
    for key, value in leaves(config):
        set_at(found, key, value)
    return found


def value_at(values: Mapping[str, Any], key: str, default: Any = None) -> Any:
    """A value of nested data by its dotted key; the default if there is none."""
    found = values
    for name in key.split("."):
        found = found.get(name, default) if isinstance(found, Mapping) else default
    return found


def set_at(values: dict[str, Any], key: str, value: Any) -> None:
    """Set a value of nested data by its dotted key, in sections that are made where there are
    none."""
    *sections, name = key.split(".")
    for each in sections:
        if not isinstance(values.get(each), dict):
            values[each] = {}
        values = values[each]
    values[name] = value


def filled(kind: type[S], values: Mapping[str, Any], path: str = "") -> S:
    """Settings of a class from plain values, whose sections are mappings; no text in them is
    resolved."""
    known = rules(kind)
    hints = _hints(kind)
    given = {}
    for name, value in values.items():
        if name not in known or known[name].fixed:
            close = difflib.get_close_matches(
                str(name), [each for each in known if not known[each].fixed], 1
            )
            hint = "".join(f"; did you mean {path}{each}?" for each in close)
            raise InputError(f"{path}{name}: unknown setting{hint}")
        declared = _base(hints[name])
        section = [*get_args(declared), declared][1] if get_origin(declared) is dict else declared
        if not (isinstance(section, type) and issubclass(section, Settings)):
            given[name] = value
        elif section is not declared:  # sections by name
            below = value.items() if isinstance(value, Mapping) else ()
            given[name] = {k: filled(section, v or {}, f"{path}{name}.{k}.") for k, v in below}
        else:
            checks.require(
                isinstance(value, Mapping),
                f"{path}{name}",
                value,
                f"is not a section; write {path}{name}=OPTION, or {path}{name}.KEY=VALUE",
            )
            given[name] = filled(section.class_for(value), value, f"{path}{name}.")
    made = kind(**given)
    made.refuse_unread()
    return made


_hints = functools.cache(get_type_hints)


def _base(hint: Any) -> Any:
    """A type without ``| None``."""
    if get_origin(hint) in (UnionType, Union):
        return next(each for each in get_args(hint) if each is not type(None))
    return hint


_KINDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
    list: "a list",
}


def _converted(key: str, value: Any, hint: Any) -> Any:
    """A value of the declared type; arrays and numbers of NumPy and torch become plain ones."""
    value = plain(value)
    kind = _base(hint)
    if kind is Any or (value is None and type(None) in get_args(hint)):
        return value
    origin = get_origin(kind) or kind
    inner = get_args(kind)
    if origin is float and checks.is_number(value):
        return float(value)
    if origin is str and checks.is_number(value):
        return str(value)  # a time such as 2
    if origin is int and (
        isinstance(value, str) or (isinstance(value, float) and value.is_integer())
    ):
        with suppress(ValueError):
            return int(value)  # 1e6, or the text of an environment variable
    good = isinstance(value, origin) and not (isinstance(value, bool) and origin is not bool)
    checks.require(good, key, value, f"is not {_KINDS.get(origin, f'a {origin.__name__}')}")
    if isinstance(value, list) and inner:
        return [_converted(key, each, inner[0]) for each in value]
    return value


def _check_value(key: str, value: Any, rule: Rule, kind: Any) -> None:
    """Check one value, or each one of a list, against its rule."""
    if isinstance(value, list) and kind is not Any:
        for each in value:
            _check_value(key, each, rule, next(iter(get_args(kind)), Any))
        return
    if rule.choices and not (rule.paths and ":" in str(value)):
        checks.one_of(key, value, rule.choices)
    if kind not in (int, float) or not checks.is_number(value):
        return
    if rule.above is not None:
        checks.above(key, value, rule.above, rule.unit)
    low = rule.low
    high = rule.high
    if low is None and high is None:
        high = checks.LARGEST.get(rule.unit, checks.HUGE)
        low = -high
    checks.in_range(key, value, -math.inf if low is None else low, high, rule.unit)


def plain(value: Any) -> Any:
    """A value with Python's own lists and numbers instead of those of NumPy and torch."""
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(each) for each in value] if type(value) in (list, tuple) else value


def check_place(key: str, place: Any) -> None:
    """Require a place: ``[x, y]`` in metres, or ``{lat: ..., lon: ...}`` in degrees."""
    if not isinstance(place, Mapping):
        checks.place(key, place)
        return
    good = set(place) == {"lat", "lon"}
    example = "{lat: 53.1, lon: -4.5}"
    checks.require(good, key, place, f"is not {{lat: ..., lon: ...}} in degrees, such as {example}")
    checks.in_range(f"{key}.lat", place["lat"], -90.0, 90.0, "deg")
    checks.in_range(f"{key}.lon", place["lon"], -360.0, 360.0, "deg")
