"""How the pure inner functions of a step are compiled; everything around them stays TorchRL's."""

from collections.abc import Callable
from typing import Any, TypeVar

import torch

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function, **options: Any) -> Function:
    """Compile a function as one graph.

    Args:
        function: tensors in, tensors out.
        options: for ``torch.compile``, in place of what suits a CPU.
    """
    # Every function has graphs of its own: it never meets another's settings.
    options = options or {"options": _INDUCTOR}
    return torch.compile(  # type: ignore[call-overload]
        function, fullgraph=True, isolate_recompiles=True, **options
    )


_INDUCTOR: dict[str, Any] = {
    # Innermost loops run over a few UAVs: vectors of 16 lanes would be mostly idle, and slower.
    "cpp.simdlen": 1,
    # Shapes may change, settings never do: checking them takes as long as a kernel.
    "guard_filter_fn": torch.compiler.keep_tensor_guards_unsafe,
}
