"""What evaluations measure: metrics by name, how each is computed, and where tables show it.

Nothing here imports torch, so that settings can name metrics.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from damian.common import checks
from damian.common.registry import Registry

Compute = Callable[[Any], Any]
"""Function from ``damian.runs.metrics.Flights`` to a tensor of numbers, or a number."""


@dataclass(frozen=True)
class Metric:
    """A number of an evaluation; ``damian.metric`` declares one of your own."""

    compute: Compute
    """Function from the flights to numbers, whose mean is the metric."""
    better: str = ""
    """``higher`` or ``lower``; with neither, methods cannot be compared by it."""
    share: bool = False
    """Whether it lies between 0 and 1, and its intervals end there."""
    where: str = ""
    """Tables show it only where a task can succeed (``success``), or where messages are late
    (``late``)."""
    tables: tuple[str, ...] = ("run", "sweep")
    """Tables that show it, beside that of ``damian compare``, which has all."""


METRICS = Registry[Metric](
    "metric", Metric, "is not a metric: decorate a function with damian.metric"
)
"""Metrics by name; those outside the package as ``package.module:name``."""


def metric(better: str = "", **declared: Any) -> Callable[[Compute], Metric]:
    """Decorator of a function from ``Flights`` to numbers; the others are fields of ``Metric``."""
    checks.one_of("better", better, ("", "higher", "lower"))
    return lambda compute: Metric(compute, better, **declared)


def declared(name: str) -> Metric:
    """What is known of a metric; one whose code nobody has named is shown like any other."""
    return METRICS[name] if name in METRICS else Metric(lambda _: float("nan"))


def check_score(name: str) -> None:
    """Require a metric by which methods can be compared."""
    checks.require(
        bool(METRICS.get(name, "score").better),
        "score",
        name,
        "is neither better when higher nor when lower: declare that, or choose another score",
    )


def _add(name: str, compute: Compute, better: str = "", **declared: Any) -> None:
    METRICS.register(name)(Metric(compute, better, **declared))


# Columns of stored tables are in this order. First what truly happened, then what the server
# perceived.
_add("success_rate", lambda flights: flights.true.succeeded, "higher", share=True, where="success")
_add("steps", lambda flights: flights.true.steps, "lower", where="success")
_add("return", lambda flights: flights.true.returns, "higher")
_add(
    "perceived_success_rate",
    lambda flights: flights.perceived.succeeded,
    "higher",
    share=True,
    tables=(),
)
_add("perceived_steps", lambda flights: flights.perceived.steps, "lower", tables=())
_add("perceived_return", lambda flights: flights.perceived.returns, "higher", where="late")
_add("age", lambda flights: flights.age[flights.in_episode], where="late")
_add("late", lambda flights: flights.delay > 0, share=True, where="late", tables=("run",))
_add("lost", lambda flights: flights.delay < 0, share=True, where="late", tables=("run",))
BUILT_IN = (*METRICS,)
"""Metrics of every evaluation."""
