"""Compiles the pure inner functions of a step; the TorchRL code around them stays uncompiled."""

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten, tree_map, tree_unflatten

Function = TypeVar("Function", bound=Callable)

COMPILE_OPTIONS = {
    "cpp.use_decompose_tanh": True,  # by exponentials, in half the time; the difference is rounding
    "fallback_random": True,  # the draws of torch's generator, as without compiling
    "cpp.vec_isa_ok": True,  # by the processor's flags, without a trial
}
"""Options of ``torch.compile`` for networks."""


class CompiledMethods:
    """The methods of an object, each compiled at its first call, with the options of ``compiled``.

    With ``cuda_graph`` each becomes a ``CudaGraph``. A copy, and what a pickle is read as, has no
    graphs: these belong to the object of the methods.
    """

    def __init__(self, options: dict[str, Any], cuda_graph: bool = False) -> None:
        self._options = options
        self._cuda_graph = cuda_graph
        self._graphs: dict[tuple[Hashable, ...], Callable] = {}

    def get(self, method: Callable, *variant: Hashable) -> Callable:
        """The compiled method; each variant of what no guard checks has its own graph."""
        key = (method.__name__, *variant)
        if key not in self._graphs:
            function = compiled(method, **self._options)
            self._graphs[key] = CudaGraph(function) if self._cuda_graph else function
        return self._graphs[key]

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return CompiledMethods, (self._options, self._cuda_graph)


class CudaGraph:
    """A function of a state, as one CUDA graph from its third call on.

    Its first two arguments are the state, its first two results the next one: trees of tensors.
    What a call returns as the state is changed in place by the next one; everything else that it
    returns stays. (With ``torch.compile(mode="reduce-overhead")`` both would be lost.)
    """

    def __init__(self, function: Callable) -> None:
        self._function = function
        self._graph = torch.cuda.CUDAGraph()
        self._calls = 0
        self._inputs: list[Tensor] = []

    def __call__(self, *args: Any) -> Any:
        """Compute the function; arguments have the shapes of the first call."""
        self._calls += 1
        if self._calls < 3:  # which compile it, once for a new state and once for a computed one
            return self._function(*args)
        if self._calls == 3:
            inputs, self._form = tree_flatten(args)
            self._inputs = [x.clone() for x in inputs]
            self._own = tree_unflatten(self._inputs, self._form)
            with torch.cuda.graph(self._graph):
                first, second, *self._others = self._function(*self._own)
                computed = tree_map(
                    Tensor.clone, (first, second)
                )  # since one may be another's input
                tree_map(Tensor.copy_, self._own[:2], computed)
        for mine, given in zip(self._inputs, self._form.flatten_up_to(args), strict=True):
            if mine is not given:
                mine.copy_(given)
        self._graph.replay()
        return *self._own[:2], *tree_map(Tensor.clone, self._others)


def compiled(function: Function, **options: Any) -> Function:
    """Compile a pure function of tensors as one graph, with options of ``torch.compile``."""
    # Recompiles are isolated, so that a function never runs a graph compiled for another's
    # settings.
    return torch.compile(  # type: ignore[call-overload]
        function, fullgraph=True, isolate_recompiles=True, **options
    )


_FEWEST_IN_VECTORS = 16
"""Smallest number of UAVs for which loops over them are vectorised."""


def world_options(n_agents: int) -> dict[str, Any]:
    """Options of ``compiled`` for the steps of worlds on a CPU."""
    return {
        "options": {
            # Guards on tensors stay, since shapes may change. Settings never do, and checking them
            # takes as long as running a kernel.
            "guard_filter_fn": torch.compiler.keep_tensor_guards_unsafe,
            # The innermost loops run over UAVs: with a few of them vectors of 16 lanes are mostly
            # idle, and slower.
            "cpp.simdlen": 1 if n_agents < _FEWEST_IN_VECTORS else None,
            # Whether the processor has vectors is read from its flags; a trial would take seconds
            # for each.
            "cpp.vec_isa_ok": True,
        }
    }
