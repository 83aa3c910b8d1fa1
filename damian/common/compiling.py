"""Compiles the pure inner functions of a step; the TorchRL code around them stays uncompiled."""

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import torch

Function = TypeVar("Function", bound=Callable[..., Any])


class CompiledMethods:
    """The methods of an object, each compiled at its first call, with the options of ``compiled``.

    A copy, and what a pickle is read as, has no graphs: these belong to the object of the methods.
    """

    def __init__(self, options: dict[str, Any]) -> None:
        self._options = options
        self._graphs: dict[tuple[Hashable, ...], Callable[..., Any]] = {}

    def get(self, method: Callable[..., Any], *variant: Hashable) -> Callable[..., Any]:
        """The compiled method; each variant of what no guard checks has its own graph."""
        key = (method.__name__, *variant)
        if key not in self._graphs:
            self._graphs[key] = compiled(method, **self._options)
        return self._graphs[key]

    def __reduce__(self) -> tuple[type["CompiledMethods"], tuple[dict[str, Any]]]:
        return CompiledMethods, (self._options,)


def compiled(function: Function, **options: Any) -> Function:
    """Compile a pure function of tensors as one graph; ``options`` replace the defaults, tuned for a CPU."""
    options = options or {"options": _INDUCTOR}
    # Recompiles are isolated, so that a function never runs a graph compiled for another's settings.
    return torch.compile(  # type: ignore[call-overload]
        function, fullgraph=True, isolate_recompiles=True, **options
    )


_INDUCTOR: dict[str, Any] = {
    # Guards on tensors stay, since shapes may change. Settings never do, and checking them takes as long as
    # running a kernel.
    "guard_filter_fn": torch.compiler.keep_tensor_guards_unsafe,
    # The innermost loops run over a few UAVs: vectors of 16 lanes would be mostly idle, and slower.
    "cpp.simdlen": 1,
    # Whether the processor has vectors is read from its flags; a trial would take seconds for each.
    "cpp.vec_isa_ok": True,
}
