"""The slow twin of the search for landing points: a loop over all of them, in exact arithmetic."""

import math
from fractions import Fraction


def centimetres(point, target) -> int:
    """Distance of two places in whole centimetres, half a one rounded up, without rounding errors.

    The boundary lies 1e-8 m below the half, so that float error cannot move a true half across it.
    """
    squared = sum((100 * (Fraction(p) - Fraction(t))) ** 2 for p, t in zip(point, target, strict=True))
    up = Fraction(500_001, 1_000_000)
    whole = math.isqrt(squared.numerator // squared.denominator)
    return whole + ((whole + 1 - up) ** 2 <= squared)


def nearest_by_loop(points, target, n) -> list[int]:
    """The n nearest points; of equally near ones the lowest id first."""
    ids = sorted(range(len(points)), key=lambda i: (centimetres(points[i], target), i))
    return (ids + [-1] * n)[:n]
