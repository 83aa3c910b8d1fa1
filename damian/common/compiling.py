"""Compiles the pure inner functions of a step; the TorchRL code around them stays uncompiled."""

from collections.abc import Callable
from typing import Any, TypeVar

import torch

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function, **options: Any) -> Function:
    """Compile a function as one graph.

    Args:
        function: a pure function of tensors that returns tensors.
        options: keyword arguments of ``torch.compile``; they replace the defaults, which are tuned for a CPU.
    """
    options = options or {"options": _INDUCTOR}
    # Recompiles are isolated, so that a function never runs a graph compiled for another's settings.
    return torch.compile(  # type: ignore[call-overload]
        function, fullgraph=True, isolate_recompiles=True, **options
    )


_INDUCTOR: dict[str, Any] = {
    # The innermost loops run over a few UAVs: vectors of 16 lanes would be mostly idle, and slower.
    "cpp.simdlen": 1,
    # Guards on tensors stay, since shapes may change. Settings never do, and checking them takes as long as
    # running a kernel.
    "guard_filter_fn": torch.compiler.keep_tensor_guards_unsafe,
}
