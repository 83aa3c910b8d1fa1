"""Connections of the service: strangers, who have not shown the token, are few, and do not stay."""

import hmac
from typing import Any, ClassVar

from uvicorn.protocols.http.h11_impl import H11Protocol

PATIENCE = 5.0
"""How long a connection may stay that has not shown the token [s]."""
MOST_STRANGERS = 100
"""How many such connections there are at a time; a newer one drives out the oldest."""


class Door(H11Protocol):
    """A connection of uvicorn, a stranger's until a request shows the token."""

    token: ClassVar[bytes] = b""
    strangers: ClassVar[dict["Door", Any]]
    """Connections that have not shown it, oldest first, with the timers that end them."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.strangers[self] = self.loop.call_later(PATIENCE, transport.abort)
        if len(self.strangers) > MOST_STRANGERS:
            oldest = next(iter(self.strangers))
            self.strangers.pop(oldest).cancel()
            oldest.transport.abort()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self in self.strangers and self.scope is not None:
            given = dict(self.scope["headers"]).get(b"authorization", b"")
            if hmac.compare_digest(given, b"Bearer " + self.token):
                self.strangers.pop(self).cancel()

    def connection_lost(self, exc: Exception | None) -> None:
        if self in self.strangers:
            self.strangers.pop(self).cancel()
        super().connection_lost(exc)


def door(token: str) -> type[Door]:
    """Connections of a service with this token."""
    return type("Door", (Door,), {"token": token.encode(), "strangers": {}})
