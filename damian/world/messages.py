"""The messages that UAVs send; a further field is declared in ``Messages`` and filled in
``Simulation``."""

from typing import Annotated, NamedTuple, get_type_hints

import torch
from torch import Tensor

from damian.common.tensors import distances, gather_rows

MAX_EXACT_INTEGER = 2**24
"""Messages are packed as float32, which holds integers up to this exactly."""


class Column(NamedTuple):
    """How a field of a message is packed."""

    width: int | None = 1
    """Number of columns; None if it depends on the settings."""
    dtype: torch.dtype = torch.float32
    """Type of the unpacked field."""


class Widths(NamedTuple):
    """How many columns the settings give to a message's fields that have no fixed number."""

    sources: int = 1
    """Number of signal sources, K."""
    readings: int = 0
    """Number of values that the user's sensors read."""
    requests: int = 0
    """Number of requests that can be open at once, M."""
    truths: int = 0
    """Number of sources of which messages tell the true detections, too: K if rewards follow
    them."""
    events: int = 0
    """Number of events that messages tell of each stop."""
    commands: int = 0
    """1 if messages tell which command was executed last."""
    announced: int = 0
    """Number of commands under way of which messages tell, D."""
    pending: int = 0
    """Number of its own latest commands that a UAV observes, P."""


ONE_SOURCE = Widths()

Number = Annotated[Tensor, Column()]
Place = Annotated[Tensor, Column(2)]
Flag = Annotated[Tensor, Column(dtype=torch.bool)]
Varying = Annotated[Tensor, Column(None)]
"""Fields whose number of columns depends on the settings."""


class Messages(NamedTuple):
    """One message of each UAV, with any leading dimensions; each field [*, N] or [*, N, width].

    It carries what the paper lists (section 3.2), the number of motions and the latest landing
    points.
    """

    time: Number
    """Time at which the message was generated [s]."""
    position: Place
    """Position of the UAV, east, north [m]."""
    target: Place
    """Landing point to which the UAV flies, or on which it stands, east, north [m]."""
    track: Number
    """Heading of the latest flight, clockwise from north [rad]."""
    battery: Number
    """Battery level, not rounded [%]."""
    spotted: Flag
    """Whether the UAV spots any source."""
    empty: Flag
    """Whether the observed battery level is 0, or the battery allows nothing but holding."""
    motions: Annotated[Tensor, Column(dtype=torch.long)]
    """Motions (holding included) since the latest detection that counts before this message."""
    detected_time: Varying
    """Time of the latest detection of each source [s], [*, N, K]; -1 if there was none."""
    detected_position: Varying
    """Position of the UAV at its latest detection of each source, east, north [m], [*, N, K, 2]."""
    true_time: Varying
    """As ``detected_time``, of when the UAV truly was in reach, [*, N, T]; T is K, or 0 if it is
    not told."""
    true_position: Varying
    """As ``detected_position``, of where the UAV truly was in reach, [*, N, T, 2]."""
    requests: Varying
    """The latest request of each slot (``damian.world.requests``) that the UAV has heard of,
    [*, N, M, 3].

    Without ``requests.range``, that which there is now, also if the UAV sends nothing.
    """
    served: Varying
    """When the latest request of each slot that the UAV has served appeared [s], [*, N, M]; -1 if
    none."""
    serves: Varying
    """Whether it serves one now, 0 or 1, [*, N, 1]; [*, N, 0] if there are no requests."""
    executed: Varying
    """Number of the command that the UAV has executed last, 0 before the first one, [*, N, 1];
    [*, N, 0] if commands are not absolute, or not late."""
    announced: Varying
    """Where the commands under way lead, the newest first, east, north [m], by when they will have
    been executed [s], and 1; zeros for no command, [*, N, D, 4]."""
    pending: Annotated[Tensor, Column(None)]
    """What the UAV knows of its own latest commands, the newest first: where each leads, east,
    north [m], when it was chosen [s], whether it, or a later one, is known to have been executed,
    and 1; zeros for no command, and in a message that is sent, [*, N, P, 5]."""
    trail: Annotated[Tensor, Column(None, torch.long)]
    """Flat ids of the landing points of the latest stops, newest first, [*, N, S]; holding is a
    stop."""
    landed: Varying
    """Time at which each of these stops began [s], [*, N, S]; -1 before the episode."""
    events: Varying
    """Whether each source was heard when each of these stops began, and, if there are requests,
    whether one was served, 0 or 1, [*, N, S, E]; E is 0 if it is not told."""
    readings: Varying
    """Readings of the user's sensors, beside each other in the order of the settings, [*, N, K]."""

    @classmethod
    def blank(cls, trail: Tensor, widths: Widths = ONE_SOURCE) -> "Messages":
        """Messages of zeros, without a detection, of UAVs with the landing points ``trail``
        [*, N, S]."""
        width = _FIXED + sum(_variable(widths)) + (2 + widths.events) * trail.shape[-1]
        blank = cls.unpack(torch.zeros(*trail.shape[:-1], width, device=trail.device), widths)
        unknown = ("detected_time", "true_time", "requests", "served")
        never = {name: getattr(blank, name) - 1 for name in unknown}
        return blank._replace(**never, trail=trail)

    def pack(self) -> Tensor:
        """Messages as rows [*, N, M] float32; integers up to ``MAX_EXACT_INTEGER`` come through
        exactly."""
        flat = {name: getattr(self, name).flatten(-2) for name in _ROWS}
        fields = zip(self._replace(**flat), _COLUMNS, strict=True)
        parts = [
            (field.unsqueeze(-1) if width == 1 else field).float() for field, (width, _) in fields
        ]
        return torch.cat(parts, -1)

    @classmethod
    def unpack(cls, rows: Tensor, widths: Widths = ONE_SOURCE) -> "Messages":
        """Messages from rows [*, N, M]; floats are views.

        ``Server.messages``, which knows the widths, is the way to unpack messages of an
        environment.
        """
        *variable, readings = _variable(widths)
        stops = (rows.shape[-1] - _FIXED - sum(variable) - readings) // (2 + widths.events)
        fixed = [column.width for column in _COLUMNS if column.width]
        told = stops * widths.events
        parts = [*rows.split([*fixed, *variable, stops, stops, told, readings], -1)]
        fields = []
        for part, (width, dtype) in zip(parts, _COLUMNS, strict=True):
            field = part.squeeze(-1) if width == 1 else part
            fields.append(field > 0.5 if dtype == torch.bool else field.to(dtype))
        found = cls._make(fields)
        return found._replace(
            detected_position=found.detected_position.unflatten(-1, (widths.sources, 2)),
            true_position=found.true_position.unflatten(-1, (widths.truths, 2)),
            requests=found.requests.unflatten(-1, (widths.requests, 3)),
            announced=found.announced.unflatten(-1, (widths.announced, 4)),
            pending=found.pending.unflatten(-1, (widths.pending, 5)),
            events=found.events.unflatten(-1, (stops, widths.events)),
        )

    @staticmethod
    def request_columns(widths: Widths) -> slice:
        """The columns of ``requests`` in packed rows."""
        first = _FIXED + sum(_variable(widths)[: _VARIABLE.index("requests")])
        return slice(first, first + 3 * widths.requests)

    @property
    def spots(self) -> Tensor:
        """Whether the UAV spots each source, [*, N, K]."""
        return self.detected_time == self.time.unsqueeze(-1)

    @property
    def of_truth(self) -> "Messages":
        """These messages, with the true detections in the place of those that the UAVs report."""
        told = self._replace(detected_time=self.true_time, detected_position=self.true_position)
        return told._replace(spotted=told.spots.any(-1))

    @property
    def in_flight(self) -> Tensor:
        """Whether the message was sent at a takeoff, so that its UAV flies to another point,
        [*, N]."""
        return (self.position != self.target).any(-1)

    def region(self, n_points: int) -> Tensor:
        """Index of the region of each world, [*], by the largest number of landing points in a
        region."""
        return self.trail[..., 0, 0] // n_points

    def bound_for(self, points: Tensor, region: Tensor) -> Tensor:
        """The landing points [R, L, 2] m on which UAVs stand, or to which they fly, in regions [*],
        flat ids [*, N]."""
        nearest = distances(self.target, gather_rows(points, region)).argmin(-1)
        goal = nearest + region.unsqueeze(-1) * points.shape[1]
        return torch.where(self.in_flight, goal, self.trail[..., 0])

    def age(self, now: Tensor) -> Tensor:
        """Age of information: time since each message was generated [s], [*, N]; ``now`` is in s,
        [*]."""
        return now.unsqueeze(-1) - self.time


_HINTS = get_type_hints(Messages, include_extras=True)
_COLUMNS: list[Column] = [hint.__metadata__[0] for hint in _HINTS.values()]
_ROWS = ("detected_position", "true_position", "requests", "announced", "pending", "events")
"""Fields that have a row for each source, request, command or stop."""
_FIXED = sum(column.width or 0 for column in _COLUMNS)
"""Number of columns of all fields whose number does not depend on the settings; they come first."""


_VARIABLE = [name for name, column in zip(_HINTS, _COLUMNS, strict=True) if column.width is None]
"""Names of the other fields."""


def _variable(widths: Widths) -> list[int]:
    """Numbers of columns of the other fields, but those of the stops."""
    n = widths.sources
    m = widths.requests
    t = widths.truths
    told = widths.commands, 4 * widths.announced, 5 * widths.pending
    return [n, 2 * n, t, 2 * t, 3 * m, m, min(m, 1), *told, widths.readings]
