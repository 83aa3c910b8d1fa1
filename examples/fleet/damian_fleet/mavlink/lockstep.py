"""Service, bridges and simulated copters in one process, faster than real time: one clock, which they share.

The clock goes on by 0.1 s when all of them have done what there was to do; messages still go over UDP, which
on one machine has them at once. So a flight depends on its seed alone, and not on how busy the machine is.
"""

import math
import socket
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

from starlette.testclient import TestClient

from damian_fleet.mavlink.bridge import Bridge, connect, step_of
from damian_fleet.mavlink.vehicles import TICK, Copter
from damian_fleet.service import make_app
from damian_fleet.session import AdviceSession

TOKEN = "only-in-this-process"
BEGIN = 1_750_000_000.0
"""When flights begin [s since 1970]."""


class Lockstep:
    """A fleet in flight; close it at the end.

    Args:
        session: the fleets of the service.
        places: latitude and longitude [deg] where each UAV stands first, by ID.
        name: of the fleet at the service.
        begin: the first time [s since 1970].
        listen: how long a landed vehicle listens before it asks [s].
        **copter: arguments of ``Copter``.
    """

    def __init__(
        self,
        session: AdviceSession,
        places: dict[str, tuple[float, float]],
        name: str = "north",
        begin: float = BEGIN,
        listen: float = 0.0,
        **copter: Any,
    ) -> None:
        self.now, self.session, self.reachable = begin, session, True
        self._open = ExitStack()
        headers = {"Authorization": f"Bearer {TOKEN}"}
        app = make_app(session, TOKEN, lambda: self.now)
        self.http = self._open.enter_context(TestClient(app, headers=headers))
        self.dt = step_of(self.ask, name, [*places])
        self.copters: list[Copter] = []
        self.bridges: list[Bridge] = []
        for i, (uav, place) in enumerate(places.items()):
            port = _free_port()
            link = connect(f"udpin:127.0.0.1:{port}")
            self._open.callback(link.close)
            self.copters.append(Copter(("127.0.0.1", port), place, begin, i + 1, up=100.0 + 17 * i, **copter))
            self._open.callback(self.copters[-1].socket.close)
            self.bridges.append(Bridge(uav, link, self.ask, name, lambda: self.now, self.dt, listen))

    def ask(self, method: str, path: str, body: Any = None) -> tuple[int, Any]:
        """A request to the service, unless it is out of reach."""
        if not self.reachable:
            raise OSError("out of reach")
        answer = self.http.request(method, path, json=body)
        return answer.status_code, answer.json()

    def run(self, seconds: float, until: Callable[[], Any] = lambda: False) -> bool:
        """Fly for so long, or until something is so; returns whether it is."""
        for _ in range(math.ceil(seconds / TICK - 1e-9)):
            if until():
                break
            self.now = round(self.now + TICK, 3)
            for copter, bridge in zip(self.copters, self.bridges, strict=True):
                copter.step(self.now)
                bridge.poll()
        return bool(until())

    def close(self) -> None:
        """Close all links and the service."""
        self._open.close()

    def said(self) -> list[Sequence[tuple[str, str]]]:
        """What each bridge has said, and the service confirmed."""
        return [bridge.said for bridge in self.bridges]


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
