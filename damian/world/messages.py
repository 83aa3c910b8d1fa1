"""The messages that UAVs send; to add a field, declare it in ``Messages`` and fill it in ``_sense``."""

from typing import Annotated, NamedTuple, get_type_hints

import torch
from torch import Tensor

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


ONE_SOURCE = Widths()


class Messages(NamedTuple):
    """One message of each UAV, with any leading dimensions; each field [*, N] or [*, N, width].

    It carries what the paper lists (section 3.2), the number of motions and the latest landing points.
    """

    time: Annotated[Tensor, Column()]
    """Time at which the message was generated [s]."""
    position: Annotated[Tensor, Column(2)]
    """Position of the UAV, east, north [m]."""
    target: Annotated[Tensor, Column(2)]
    """Landing point to which the UAV flies, or on which it stands, east, north [m]."""
    track: Annotated[Tensor, Column()]
    """Heading of the latest flight, clockwise from north [rad]."""
    battery: Annotated[Tensor, Column()]
    """Battery level, not rounded [%]."""
    spotted: Annotated[Tensor, Column(dtype=torch.bool)]
    """Whether the UAV spots any source."""
    empty: Annotated[Tensor, Column(dtype=torch.bool)]
    """Whether the observed battery level is 0, or the battery allows nothing but holding."""
    motions: Annotated[Tensor, Column(dtype=torch.long)]
    """Motions (holding included) since the latest detection before this message."""
    detected_time: Annotated[Tensor, Column(None)]
    """Time of the latest detection of each source [s], [*, N, K]; -1 if there was none."""
    detected_position: Annotated[Tensor, Column(None)]
    """Position of the UAV at its latest detection of each source, east, north [m], [*, N, K, 2]."""
    trail: Annotated[Tensor, Column(None, torch.long)]
    """Flat ids of the landing points of the latest stops, newest first, [*, N, S]; holding is a stop."""
    landed: Annotated[Tensor, Column(None)]
    """Time at which each of these stops began [s], [*, N, S]; -1 before the episode."""
    readings: Annotated[Tensor, Column(None)]
    """Readings of the user's sensors, beside each other in the order of the settings, [*, N, K]."""

    @classmethod
    def blank(cls, trail: Tensor, widths: Widths = ONE_SOURCE) -> "Messages":
        """Messages of zeros, without a detection, of UAVs with the landing points ``trail`` [*, N, S]."""
        width = _FIXED + 3 * widths.sources + 2 * trail.shape[-1] + widths.readings
        blank = cls.unpack(torch.zeros(*trail.shape[:-1], width, device=trail.device), widths)
        return blank._replace(detected_time=blank.detected_time - 1, trail=trail)

    def pack(self) -> Tensor:
        """Messages as rows [*, N, M] float32; integers up to ``MAX_EXACT_INTEGER`` come through exactly."""
        fields = zip(
            self._replace(detected_position=self.detected_position.flatten(-2)), _COLUMNS, strict=True
        )
        parts = [(field.unsqueeze(-1) if width == 1 else field).float() for field, (width, _) in fields]
        return torch.cat(parts, -1)

    @classmethod
    def unpack(cls, rows: Tensor, widths: Widths = ONE_SOURCE) -> "Messages":
        """Messages from rows [*, N, M]; floats are views.

        ``Server.messages``, which knows the widths, is the way to unpack messages of an environment.
        """
        n, readings = widths
        stops = (rows.shape[-1] - _FIXED - 3 * n - readings) // 2
        fixed = [column.width for column in _COLUMNS[:-5]]
        parts = [*rows.split([*fixed, n, 2 * n, stops, stops, readings], -1)]
        parts[-4] = parts[-4].unflatten(-1, (n, 2))
        fields = []
        for part, (width, dtype) in zip(parts, _COLUMNS, strict=True):
            field = part.squeeze(-1) if width == 1 else part
            fields.append(field > 0.5 if dtype == torch.bool else field.to(dtype))
        return cls._make(fields)

    @property
    def in_flight(self) -> Tensor:
        """Whether the message was sent at a takeoff, so that its UAV flies to another point, [*, N]."""
        return (self.position != self.target).any(-1)

    def region(self, n_points: int) -> Tensor:
        """Index of the region of each world, [*], by the largest number of landing points in a region."""
        return self.trail[..., 0, 0] // n_points

    def age(self, now: Tensor) -> Tensor:
        """Age of information: time since each message was generated [s], [*, N]; ``now`` is in s, [*]."""
        return now.unsqueeze(-1) - self.time


_HINTS = get_type_hints(Messages, include_extras=True)
_COLUMNS: list[Column] = [hint.__metadata__[0] for hint in _HINTS.values()]
_FIXED = sum(column.width or 0 for column in _COLUMNS)
"""Number of columns of all fields but the last five, those of detections, stops and readings."""
