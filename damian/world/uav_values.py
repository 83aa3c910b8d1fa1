"""A check of the values that a component of the user's own returns for UAVs."""

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from damian.common import checks
from damian.common.errors import InputError


def check_uav_values(
    name: str, found: Any, shape: Sequence[int], width: int | None = 1, why: str = ""
) -> None:
    """Check that a component of the user's own has returned finite values for each UAV.

    Args:
        name: of the component, for errors.
        found: what it returned.
        shape: number of initial conditions and of UAVs, [Q, N].
        width: number of values for each UAV: [Q, N] for 1, else [Q, N, width]; None if it may be any number.
        why: what declares the width, for errors.

    Raises:
        InputError: it has returned something else.
    """
    if not isinstance(found, Tensor):
        raise InputError(f"{name}: a {type(found).__name__} is not a tensor")
    last = [] if width == 1 else [width or "K"]
    actual, good = list(found.shape), found.dim() == len(shape) + len(last)
    good = good and actual == [*shape, *(actual[-1:] if width is None else last)]
    expected = ", ".join(map(str, [*shape, *last]))
    meaning = f"[initial conditions, UAVs{', values' if last else ''}]"
    checks.require(good, name, f"shape {actual}", f"is not [{expected}] = {meaning}{why}")
    bad = found[~found.isfinite()][:1].tolist()
    checks.require(not bad, name, bad, "is not finite")
