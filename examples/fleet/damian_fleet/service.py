"""The service over HTTP: reports in, advice out, several fleets at once.

Requests carry ``Authorization: Bearer TOKEN``; whoever has the wrong one learns nothing, not even which
fleets there are. Only the time, the health and the description of the service need none.
"""

import asyncio
import contextlib
import gc
import hmac
import json
import logging
import time
from collections.abc import AsyncIterator, Callable, Sequence
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from damian.common.errors import InputError, RunError
from damian.common.text_files import one_line
from damian.field.rows import (
    parsed_json,
    reports_of,
    rows_of_csv,
    rows_of_json,
    validated,
    written,
)
from damian.show.geojson import on_earth
from damian_fleet import api
from damian_fleet.answers import acknowledgements_of, as_csv, as_rows, ignored
from damian_fleet.clock import Clock
from damian_fleet.fleet import Waiting
from damian_fleet.journal import Change, Command
from damian_fleet.session import AdviceSession, NoFleet

MAX_BODY = 1_000_000
"""Largest body of a request [bytes]."""
TICK = 1.0
"""Time between two updates of all fleets [s], so that no request waits for many steps."""
PUSH = 0.5
"""Time between two looks for answers to push [s]."""
ALIVE = 15.0
"""Time after which a comment is pushed where nothing else is [s], by which a broken connection shows."""
MOST_LOGGED = 10
"""Lines that a log gets within a minute."""
_CSV = "text/csv"
_BUSY = (
    b"HTTP/1.1 503 Service Unavailable\r\ncontent-length: 0\r\nretry-after: 1\r\nconnection: close\r\n\r\n"
)


def make_app(
    session: AdviceSession, token: str, clock: Callable[[], float] | None = None, version: str = ""
) -> Starlette:
    """The service as an ASGI application; ``clock`` tells its time [s since 1970]."""
    clock = clock or Clock()
    service = Service(session, token, clock, version)
    routes = [Route(each.path, getattr(service, each.name), methods=[each.method]) for each in api.ENDPOINTS]

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
    n_frozen = 0
    while True:
        if isinstance(clock, Clock):
            clock.watch()
        if len(session.fleets) > n_frozen:  # or every full collection of garbage looks through all of them
            n_frozen = len(session.fleets)
            gc.freeze()
        try:
            for _ in session.upkeep(clock):
                await asyncio.sleep(0)
        except Exception:  # of one fleet: the others go on
            logging.getLogger("damian_fleet").exception("a fleet could not be brought up to date")
        await asyncio.sleep(TICK)


class Sparse(logging.Filter):
    """Lets few lines of a log through within a minute, and counts the others."""

    def __init__(self) -> None:
        super().__init__()
        self.since, self.n = time.monotonic(), 0

    def filter(self, record: logging.LogRecord) -> bool:
        if time.monotonic() - self.since > 60:
            if self.n > MOST_LOGGED:
                record.msg = f"{record.msg} (before it, {self.n - MOST_LOGGED} lines were left out)"
            self.since, self.n = time.monotonic(), 0
        self.n += 1
        return self.n <= MOST_LOGGED


def limited(most: int) -> type[HttpToolsProtocol]:
    """The protocol of connections, at most so many at a time; others are answered 503 and closed."""

    class Limited(HttpToolsProtocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            if len(self.connections) > most:
                transport.write(_BUSY)
                transport.close()

    return Limited


class Service:
    """The requests, which ``api`` describes; arguments as of ``make_app``."""

    def __init__(
        self, session: AdviceSession, token: str, clock: Callable[[], float], version: str = ""
    ) -> None:
        self.session, self.token, self.clock, self.version = session, token, clock, version

    # What needs no token.

    async def page(self, _: Request) -> Response:
        return HTMLResponse(api.page())

    async def openapi(self, _: Request) -> Response:
        return JSONResponse(api.openapi(self.version))

    async def health(self, _: Request) -> Response:
        problem, n_fleets = self.session.problem, len(self.session.names)
        said = {"status": "failing" if problem else "ok", "problem": problem, "fleets": n_fleets}
        return JSONResponse({**said, "version": self.version}, 503 if problem else 200)

    async def time(self, _: Request) -> Response:
        now, clock = self.clock(), self.clock
        ahead, jumps = (clock.ahead, clock.jumps) if isinstance(clock, Clock) else (0.0, 0)
        said = {"time": now, "written": written(now), "system_ahead": round(ahead, 3), "jumps": jumps}
        return JSONResponse(said)

    # Fleets.

    async def list(self, request: Request) -> Response:
        self._check_token(request)
        return JSONResponse({"fleets": self.session.names})

    async def put(self, request: Request) -> Response:
        name, body = self._name(request), parsed_json(await _body(request))
        created = self.session.create(name, body.get("uavs") if isinstance(body, dict) else None)
        return JSONResponse({"fleet": name, "uavs": self.session.fleet(name).uavs}, 201 if created else 200)

    async def get(self, request: Request) -> Response:
        name = self._name(request)
        return JSONResponse(self.session.fleet(name).status(name).model_dump(exclude_unset=True))

    async def delete(self, request: Request) -> Response:
        self.session.end(self._name(request), self.clock())
        return Response(status_code=204)

    async def command(self, request: Request) -> Response:
        name = self._name(request)
        uavs = self.session.command(name, validated(Command, parsed_json(await _body(request))), self.clock())
        return JSONResponse({"fleet": name, "uavs": uavs})

    async def members(self, request: Request) -> Response:
        name = self._name(request)
        change = validated(Change, parsed_json(await _body(request)))
        uavs = self.session.change_members(name, change, self.clock())
        return JSONResponse({"fleet": name, "uavs": uavs})

    async def geofence(self, request: Request) -> Response:
        region = self.session.fleet(self._name(request)).ground.region
        if region.origin is None:
            raise InputError(f"geofence: {region.name} has no place on Earth")
        shape = on_earth(region.polygon, region.origin)
        return JSONResponse({"type": "Feature", "properties": {"name": region.name}, "geometry": shape})

    # Reports and advice.

    async def reports(self, request: Request) -> Response:
        name, rows = self._name(request), reports_of(await _rows(request))
        unknown = ignored(rows)
        found = self.session.report(name, rows, self.clock())
        note = {"ignored": unknown} if unknown else {}
        return JSONResponse({"accepted": len(found), "found": found, **note})

    async def acknowledge(self, request: Request) -> Response:
        name, rows = self._name(request), acknowledgements_of(await _rows(request))
        return JSONResponse({"status": self.session.acknowledge(name, rows, self.clock())})

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

    async def events(self, request: Request) -> Response:
        name, uavs = self._name(request), request.query_params.getlist("uav") or None
        fleet = self.session.fleet(name)
        fleet.numbers_of(uavs)
        if not fleet.rules.acknowledge:
            raise InputError("events: a UAV would be taken to follow each of them: needs acknowledge=true")
        return StreamingResponse(self.pushed(name, uavs), media_type="text/event-stream")

    async def pushed(self, name: str, uavs: Sequence[str] | None) -> AsyncIterator[str]:
        """The events, for ever or until the fleet ends; UAVs that are not known to be in flight choose."""
        last: dict[str, Any] = {}
        quiet = 0.0
        while name in self.session.names:
            with contextlib.suppress(Waiting, RunError):
                rows = as_rows(self.session.advise(name, self.clock()))
                rows = [row for row in rows if uavs is None or row["ID"] in uavs]
                new = [row for row in rows if last.get(row["ID"]) != (row["answer"], row["state"])]
                last |= {row["ID"]: (row["answer"], row["state"]) for row in new}
                for row in new:
                    quiet = 0.0
                    yield f"event: advice\ndata: {json.dumps(row)}\n\n"
            quiet += PUSH
            if quiet >= ALIVE:
                quiet = 0.0
                yield ": nothing new\n\n"
            await asyncio.sleep(PUSH)

    def _name(self, request: Request) -> str:
        """The fleet of a request that has the token."""
        self._check_token(request)
        return request.path_params["name"]

    def _check_token(self, request: Request) -> None:
        """Refuse a request that has not the token."""
        scheme, _, given = request.headers.get("authorization", "").partition(" ")
        fits = hmac.compare_digest(given.strip().encode(), self.token.encode())
        if scheme.lower() != "bearer" or not fits:
            raise HTTPException(401, "the token is missing or wrong", {"WWW-Authenticate": "Bearer"})


async def _rows(request: Request) -> list[tuple[str, Any]]:
    """The rows of a body, JSON or CSV."""
    body = await _body(request)
    is_table = request.headers.get("content-type", "").startswith(_CSV)
    return rows_of_csv(body.decode("utf-8-sig", "replace")) if is_table else rows_of_json(body)


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
