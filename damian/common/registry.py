"""Components by name, or by the path of a class or function of a user's own:
``package.module:Name``.

Nothing else in the package imports what a setting names, because importing a module runs it.
"""

import functools
import importlib
import inspect
import os
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.metadata import entry_points
from pkgutil import resolve_name
from typing import Any, Generic, NamedTuple, TypeVar, cast

from damian.common import checks
from damian.common.errors import InputError, described

T = TypeVar("T")
Component = TypeVar("Component")


class _Door(NamedTuple):
    """What may be imported while settings that come from a file are in use."""

    named: Collection[str]
    trust: bool


_door: ContextVar[_Door | None] = ContextVar("door", default=None)


@contextmanager
def stored_settings(named: Collection[str] = (), trust: bool = False) -> Iterator[None]:
    """While settings that come from a file are in use, import only the paths that are ``named``
    elsewhere.

    The file may come from anybody. What has been registered or imported before stays usable. With
    ``trust`` any path is imported. Of nested ones the outermost decides.
    """
    before = _door.set(_door.get() or _Door(frozenset(named), trust))
    try:
        yield
    finally:
        _door.reset(before)


class Registry(Generic[T]):
    """Components of one kind.

    ``@LAWS.register("uniform")`` adds a class to the registry ``LAWS``, and
    ``LAWS.get("uniform", key)`` returns it. ``LAWS.get("my_lab.delays:Satellite", key)`` imports a
    class that is not registered, also from the current folder, so that your own file needs no
    installation. An installed package that declares its module as an entry point ``damian.plugins``
    registers names in the same way.

    Args:
        kind: what a component is called in errors, such as ``law``.
        fits: the class of components, or a function that says whether an imported object is one.
        problem: what is wrong with an object that does not fit, as in ``is not a law``.
    """

    def __init__(self, kind: str, fits: type | Callable[[Any], bool], problem: str) -> None:
        self.kind = kind
        self._fits = fits
        self._problem = problem
        self._components: dict[
            str, T
        ] = {}  # registered ones, and those that ``get`` has imported last

    def register(self, name: str) -> Callable[[Component], Component]:
        """Decorator that adds a component under a name."""

        def add(component: Component) -> Component:
            if name in self._components or ":" in name:
                raise ValueError(f"{self.kind} {name}: the name is taken, or looks like a path")
            self._components[name] = cast(T, component)
            return component

        return add

    def get(self, name: Any, key: str) -> T:
        """The component with this name or path; errors name the setting ``key``."""
        if not isinstance(name, str) or ":" not in name:
            if name not in self:
                load_plugins()
            if name in self:
                return self._components[name]
            known = f"one of {', '.join(self)}, nor " if [*self] else ""
            raise InputError(f"{key}: {name} is not {known}a path such as package.module:Name")
        door = _door.get()
        if door and not door.trust and name not in door.named and name not in self:
            remedy = "repeat that override, or add trust=true if you know where the run comes from"
            raise InputError(f"{key}: this run uses code outside DAMIAN ({name}): {remedy}")
        component = _import_path(
            name, key
        )  # each time, because a module may have been loaded again
        fits = self._fits
        good = isinstance(component, fits) if isinstance(fits, type) else fits(component)
        checks.require(good, key, name, self._problem)
        self._components[name] = component
        return component

    def read(self, written: Any, key: str, entry: str) -> tuple[str, T, dict[str, Any]]:
        """Name or path, component and parameters of ``{entry: package.module:name, parameter: ...,
        ...}``."""
        if not isinstance(written, Mapping) or entry not in written:
            raise InputError(
                f"{key}: {written} is not {{{entry}: package.module:name, parameter: value}}"
            )
        path = written[entry]
        parameters = {str(name): value for name, value in written.items() if name != entry}
        return path, self.get(path, f"{key}.{entry}"), parameters

    def __getitem__(self, name: str) -> T:
        """The component that ``get`` has found last: a compiled step cannot import anything."""
        return self._components[name]

    def __iter__(self) -> Iterator[str]:
        """Registered names, in order of registration."""
        return (name for name in self._components if ":" not in name)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and name in self._components


@functools.cache
def load_plugins() -> None:
    """Import the modules that installed packages declare as entry points ``damian.plugins``."""
    for point in entry_points(group="damian.plugins"):
        point.load()


def name_of(parameters: dict[str, Any], default: str, key: str) -> str:
    """Take the entry ``name``, which tells components of one function apart, out of the
    parameters."""
    name = parameters.pop("name", default)
    checks.require(
        str(name).isidentifier(), f"{key}.name", name, "is not a name of letters, digits and _"
    )
    return name


def parameters_of(function: Callable) -> dict[str, inspect.Parameter]:
    """The keyword-only arguments of a function, by name."""
    accepted = inspect.signature(function).parameters
    return {
        name: each for name, each in accepted.items() if each.kind is inspect.Parameter.KEYWORD_ONLY
    }


def check_parameters(function: Callable, given: Mapping[str, Any], path: str, key: str) -> None:
    """Require that ``given`` are the keyword-only arguments of a function; ``path`` names it in
    errors."""
    known = parameters_of(function)
    for name, value in given.items():
        checks.require(
            name in known,
            f"{key}.{name}",
            value,
            f"is not a parameter of {path}, which has {', '.join(known) or 'none'}",
        )
    missing = [
        name for name, each in known.items() if each.default is each.empty and name not in given
    ]
    checks.require(not missing, key, path, f"needs a value for {', '.join(missing)}")


resolved = resolve_name
"""The class or function at a path that code names, not a setting; it is imported when it is
needed."""


def _import_path(path: str, key: str) -> Any:
    """The object at ``package.module:Name``, also from a module of the current folder."""
    module_name, _, name = path.partition(":")
    folder = os.getcwd()
    if folder not in sys.path:
        sys.path.append(
            folder
        )  # it stays there: worker processes inherit it and import the module again
    try:
        module = importlib.import_module(module_name)
    except InputError as error:
        raise InputError(f"{key}: {path}: {error}") from error
    except Exception as error:  # the module of a user can raise anything
        if isinstance(error, ModuleNotFoundError) and f"{module_name}.".startswith(
            f"{error.name}."
        ):
            problem = f"{error}; {module_name} must be installed, on PYTHONPATH, or in {folder}"
        else:
            problem = f"importing it raised {described(error)}"
        raise InputError(f"{key}: {path}: {problem}") from error
    if not hasattr(module, name):
        raise InputError(f"{key}: {path}: the module {module_name} has no {name}")
    return getattr(module, name)
