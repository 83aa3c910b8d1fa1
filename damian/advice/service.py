"""The service over HTTP: reports in, advice out, several fleets at once.

Requests carry ``Authorization: Bearer TOKEN``; whoever has the wrong one learns nothing, not even which
fleets there are.
"""

import asyncio
import contextlib
import hmac
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from damian.advice.fleet import Waiting
from damian.advice.rows import as_csv, as_rows, parsed_json, read_csv, read_json
from damian.advice.session import AdviceSession, NoFleet
from damian.common.errors import InputError, RunError
from damian.common.text_files import one_line

MAX_BODY = 1_000_000
"""Largest body of a request [bytes]."""
TICK = 1.0
"""Time between two updates of all fleets [s], so that no request waits for many steps."""
_CSV = "text/csv"


def make_app(session: AdviceSession, token: str, clock: Callable[[], float] = time.time) -> Starlette:
    """The service as an ASGI application."""
    service = Service(session, token, clock)
    routes = [
        Route("/fleets/{name}", service.put, methods=["PUT"]),
        Route("/fleets/{name}", service.get, methods=["GET"]),
        Route("/fleets/{name}", service.delete, methods=["DELETE"]),
        Route("/fleets/{name}/reports", service.reports, methods=["POST"]),
        Route("/fleets/{name}/advice", service.advice, methods=["GET"]),
    ]

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        ticking = asyncio.create_task(_tick(session, clock))
        try:
            yield
        finally:
            ticking.cancel()
            session.close()

    handlers: dict[Any, Any] = {
        InputError: lambda _, error: _error(422, str(error)),
        NoFleet: lambda _, error: _error(404, str(error)),
        Waiting: lambda _, error: _error(409, str(error)),
        RunError: lambda _, error: _error(507, str(error)),
        HTTPException: lambda _, error: _error(error.status_code, str(error.detail), error.headers),
    }
    return Starlette(routes=routes, lifespan=lifespan, exception_handlers=handlers)


async def _tick(session: AdviceSession, clock: Callable[[], float]) -> None:
    """Let the fleets take their steps, one fleet at a time, so that requests come in between."""
    while True:
        for fleet in list(session.fleets.values()):
            fleet.advance(clock())
            await asyncio.sleep(0)
        await asyncio.sleep(TICK)


class Service:
    """The requests; arguments as of ``make_app``."""

    def __init__(self, session: AdviceSession, token: str, clock: Callable[[], float]) -> None:
        self.session, self.token, self.clock = session, token, clock

    async def put(self, request: Request) -> Response:
        """Create a fleet, or find it."""
        name, body = self._name(request), parsed_json(await _body(request))
        created = self.session.create(name, body.get("uavs") if isinstance(body, dict) else None)
        return JSONResponse({"fleet": name, "uavs": self.session.fleet(name).uavs}, 201 if created else 200)

    async def get(self, request: Request) -> Response:
        """What is known of a fleet."""
        name = self._name(request)
        return JSONResponse(self.session.fleet(name).status(name).model_dump(exclude_unset=True))

    async def delete(self, request: Request) -> Response:
        """End a fleet."""
        self.session.end(self._name(request), self.clock())
        return Response(status_code=204)

    async def reports(self, request: Request) -> Response:
        """Take reports, as JSON or as a CSV table."""
        name, body = self._name(request), await _body(request)
        is_table = request.headers.get("content-type", "").startswith(_CSV)
        rows = read_csv(body.decode("utf-8-sig", "replace")) if is_table else read_json(body)
        found = self.session.report(name, rows, self.clock())
        return JSONResponse({"accepted": len(found), "found": found})

    async def advice(self, request: Request) -> Response:
        """Advise all UAVs, or those that ask: ``?uav=A&uav=B``; as a table with ``?format=csv``."""
        name, wanted = self._name(request), request.query_params
        kind = wanted.get("format", "json")
        if {*wanted} - {"uav", "format"} or kind not in ("csv", "json"):
            raise InputError("query: give uav=ID, once for each that asks, and format=json or csv")
        asking = wanted.getlist("uav") or None
        answer = self.session.advise(name, self.clock(), asking, only=asking is not None)
        if kind == "csv":
            return Response(as_csv(answer), media_type=_CSV)
        return JSONResponse({"fleet": name, "advice": as_rows(answer)})

    def _name(self, request: Request) -> str:
        """The fleet of a request that has the token."""
        scheme, _, given = request.headers.get("authorization", "").partition(" ")
        fits = hmac.compare_digest(given.strip().encode(), self.token.encode())
        if scheme.lower() != "bearer" or not fits:
            raise HTTPException(401, "the token is missing or wrong", {"WWW-Authenticate": "Bearer"})
        return request.path_params["name"]


async def _body(request: Request) -> bytes:
    """The body of a request, unless it is too large."""
    body = bytearray()
    async for part in request.stream():
        body += part
        if len(body) > MAX_BODY:
            raise HTTPException(413, f"the body is larger than {MAX_BODY} bytes", {"Connection": "close"})
    return bytes(body)


def _error(code: int, text: str, headers: Any = None) -> Response:
    return JSONResponse({"error": one_line(text)}, code, headers)
