"""The ground of a fleet: places in reports, as landing points of its region, and back."""

import math

import numpy as np
import shapely

from damian.common.errors import InputError
from damian.world.airspace import Airspace
from damian.world.regions.geodesy import to_latlon, to_local

Place = tuple[float, float]
"""Latitude and longitude [deg], or over a region without a place on Earth x and y [m]."""
DEGREES, METRES = ("lat", "lon"), ("x", "y")
"""Columns of a place."""
REMEMBERED = 10_000
"""Places whose landing points are remembered, because each is looked up several times."""
DIGITS = {DEGREES: 8, METRES: 3}
"""Decimals of a place in answers: a millimetre."""


class Ground:
    """Landing points of a region, as reports and answers name places.

    Args:
        airspace: the first of its regions is flown over.
        reach: longest distance of a reported place from the nearest landing point [m].
    """

    def __init__(self, airspace: Airspace, reach: float) -> None:
        self.region, self.reach = airspace.regions[0], reach
        self.columns = METRES if self.region.origin is None else DEGREES
        self.points = airspace.exact_points[0, : int(airspace.n_points[0])].numpy()
        self._found: dict[Place, int] = {}
        self._places: dict[int, Place] = {}
        self._ways: dict[tuple[int, int], tuple[float, float]] = {}
        self._tree = shapely.STRtree(np.asarray(shapely.points(self.points)))

    def landing_point(self, place: Place) -> int:
        """Number of the landing point nearest to a place.

        Raises:
            InputError: it is farther away than ``reach``.
        """
        if place in self._found:
            return self._found[place]
        first, second = place
        x, y = self.local(place)
        point = int(self._tree.nearest(shapely.Point(x, y)))
        away = float(np.hypot(*(self.points[point] - (x, y))))
        if away > self.reach:
            names, unit = self.columns, "m" if self.region.origin is None else "deg"
            raise InputError(
                f"{names[0]}, {names[1]}: {first:.10g}, {second:.10g} {unit} is {away:.0f} m away from the "
                f"nearest landing point of {self.region.name}, more than {self.reach:.0f} m"
            )
        if len(self._found) >= REMEMBERED:
            self._found.clear()
        self._found[place] = point
        return point

    def local(self, place: Place) -> tuple[float, float]:
        """A place, east and north of the origin of the region [m]."""
        first, second = place
        if self.region.origin is None:
            return first - self.region.offset[0], second - self.region.offset[1]
        x, y = to_local(first, second, self.region.origin)
        return float(x), float(y)

    def place(self, point: int) -> Place:
        """Where a landing point is."""
        if point in self._places:
            return self._places[point]
        x, y = self.points[point]
        if self.region.origin is None:
            place = x + self.region.offset[0], y + self.region.offset[1]
        else:
            place = to_latlon(x, y, self.region.origin)
        digits = DIGITS[self.columns]
        self._places[point] = round(float(place[0]), digits), round(float(place[1]), digits)
        return self._places[point]

    def way(self, origin: int, goal: int) -> tuple[float, float]:
        """Distance between two landing points [m] and heading, clockwise from north [deg]; two decimals."""
        if (origin, goal) not in self._ways:
            if len(self._ways) >= REMEMBERED:
                self._ways.clear()
            east, north = (float(each) for each in self.points[goal] - self.points[origin])
            heading = math.degrees(math.atan2(east, north)) % 360
            self._ways[origin, goal] = round(math.hypot(east, north), 2), round(heading, 2)
        return self._ways[origin, goal]
