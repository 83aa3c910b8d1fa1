"""Components by name, or by the path of a class or function of one's own: ``package.module:Name``."""

import importlib
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar, cast

from damian.common.errors import InputError

T = TypeVar("T")
Component = TypeVar("Component")


class Registry(Generic[T]):
    """Components of one kind.

    With ``LAWS = Registry[type[Law]]("law")``, ``@LAWS.register("uniform")`` adds a class and
    ``LAWS.get("uniform", key)`` returns it. ``LAWS.get("my_lab.delays:Satellite", key)`` imports a class that
    is not registered, also from the current folder, so that a file of one's own needs no installation.

    Args:
        kind: what a component is called in errors, such as ``law``.
        problem: says what is wrong with an imported object; None if it is a component of this kind.
    """

    def __init__(self, kind: str, problem: Callable[[Any], str | None] = lambda _: None) -> None:
        self.kind, self._problem = kind, problem
        self._components: dict[str, T] = {}
        self._imported: dict[str, T] = {}

    def register(self, name: str) -> Callable[[Component], Component]:
        """Decorator that adds a component under a name.

        Raises:
            ValueError: the name is taken, or looks like a path.
        """

        def add(component: Component) -> Component:
            if name in self._components or ":" in name:
                raise ValueError(f"{self.kind} {name}: the name is taken, or looks like a path")
            self._components[name] = cast(T, component)
            return component

        return add

    def get(self, name: Any, key: str) -> T:
        """The component of a name or path.

        Args:
            name: registered, or ``package.module:Name``.
            key: of the setting, for errors.

        Raises:
            InputError: there is none.
        """
        for components in (self._components, self._imported):
            if isinstance(name, str) and name in components:
                return components[name]
        if not isinstance(name, str) or ":" not in name:
            known = ", ".join(self._components)
            raise InputError(f"{key}: {name} is not one of {known}, nor a path such as package.module:Name")
        component = _import_path(name, key)
        if problem := self._problem(component):
            raise InputError(f"{key}: {name} {problem}")
        self._imported[name] = component
        return component

    def __iter__(self) -> Iterator[str]:
        """Registered names, in order of registration."""
        return iter(self._components)

    def __contains__(self, name: object) -> bool:
        return name in self._components

    def items(self) -> Iterator[tuple[str, T]]:
        """Registered names and components."""
        yield from self._components.items()


def _import_path(path: str, key: str) -> Any:
    """The object at ``package.module:Name``.

    Raises:
        InputError: the module cannot be imported, or has no such object.
    """
    module_name, _, name = path.partition(":")
    try:
        module = _module(module_name)
    except ImportError as error:
        raise InputError(
            f"{key}: {path}: {error}; {module_name} must be installed, on PYTHONPATH, or in {os.getcwd()}"
        ) from error
    except Exception as error:  # the module of a user can raise anything
        raise InputError(f"{key}: {path}: importing it raised {type(error).__name__}: {error}") from error
    if not hasattr(module, name):
        raise InputError(f"{key}: {path}: the module {module_name} has no {name}")
    return getattr(module, name)


def _module(name: str) -> Any:
    """A module, also from the current folder."""
    folder = os.getcwd()
    if folder in sys.path:
        return importlib.import_module(name)
    sys.path.append(folder)
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(folder)
