"""The service over HTTP: reports in, advice out, several fleets at once.

Requests carry ``Authorization: Bearer TOKEN``: the token of the service, which may do anything, or that of a
fleet, which may do anything but create and end fleets, and only in its own. Whoever has the wrong one learns
nothing, not even which fleets there are.
"""

import asyncio
import base64
import contextlib
import hashlib
import hmac
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from damian.advice.fleet import Waiting
from damian.advice.rows import Rows, as_csv, as_rows, parsed_json, read_csv, read_json
from damian.advice.session import AdviceSession, NoFleet
from damian.common.errors import InputError, RunError
from damian.common.text_files import one_line

MAX_BODY = 1_000_000
"""Largest body of a request [bytes]."""
MAX_READ = 50_000_000
"""Bytes of a body that are read: who still sends does not listen to the answer that it is too large."""
TICK = 1.0
"""Time between two updates of all fleets [s], so that no request waits for many steps."""
_CSV, _LINES = "text/csv", "application/x-ndjson"
_CHALLENGE = {"WWW-Authenticate": "Bearer"}

Handler = Callable[[Request], Awaitable[Response]]


def fleet_token(token: str, name: str) -> str:
    """The token of a fleet, which follows from that of the service."""
    digest = hmac.digest(token.encode(), f"fleet {name}".encode(), hashlib.sha256)
    return base64.urlsafe_b64encode(digest).decode().rstrip("=")


def make_app(session: AdviceSession, token: str, clock: Callable[[], float] = time.time) -> Starlette:
    """The service as an ASGI application.

    Args:
        session: the fleets.
        token: of the service.
        clock: the current time [s].
    """
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
        self._making = asyncio.Lock()

    async def put(self, request: Request) -> Response:
        """Create a fleet; or say its token again, if it has these UAVs."""
        name = self._name(request, whole=True)
        body = parsed_json(await _body(request), "body")
        uavs = self.session.check_new(name, body.get("uavs") if isinstance(body, dict) else None).uavs
        async with self._making:
            known = name in self.session.fleets
            made = None if known else await asyncio.to_thread(self.session.make, uavs)
            created = self.session.create(name, uavs, made)  # another request may have come in between
        answer = {"fleet": name, "uavs": uavs, "token": fleet_token(self.token, name)}
        return JSONResponse(answer, 201 if created else 200)

    async def get(self, request: Request) -> Response:
        """What is known of a fleet."""
        return JSONResponse(self.session.status(self._name(request)).model_dump(exclude_unset=True))

    async def delete(self, request: Request) -> Response:
        """End a fleet."""
        self.session.end(self._name(request, whole=True), self.clock())
        return Response(status_code=204)

    async def reports(self, request: Request) -> Response:
        """Take reports."""
        name = self._name(request)
        self.session.fleet(name)
        body = await _body(request)
        found = self.session.report(name, _rows(request, body), self.clock())
        return JSONResponse({"accepted": len(found), "found": found})

    async def advice(self, request: Request) -> Response:
        """Advise all UAVs, or those that ask: ``?uav=A&uav=B``; as a table with ``?format=csv``."""
        name, wanted = self._name(request), request.query_params
        self.session.fleet(name)
        unknown = {*wanted} - {"uav", "format"}
        kind = wanted.get("format", "csv" if _CSV in request.headers.get("accept", "") else "json")
        if unknown or kind not in ("csv", "json"):
            raise InputError("query: give uav=ID, once for each that asks, and format=json or csv")
        asking = wanted.getlist("uav") or None
        answer = self.session.advise(name, self.clock(), asking, only=asking is not None)
        if kind == "csv":
            return Response(as_csv(answer), media_type=_CSV)
        return JSONResponse({"fleet": name, "advice": as_rows(answer)})

    def _name(self, request: Request, whole: bool = False) -> str:
        """The fleet of a request that may do what it asks.

        Args:
            request: the request.
            whole: only the token of the service allows it.
        """
        name = request.path_params["name"]
        scheme, _, given = request.headers.get("authorization", "").partition(" ")
        tokens = [self.token] if whole else [self.token, fleet_token(self.token, name)]
        fits = [hmac.compare_digest(given.strip().encode(), token.encode()) for token in tokens]
        if scheme.lower() != "bearer" or not any(fits):
            raise HTTPException(401, "the token is missing or wrong", _CHALLENGE)
        return name


def _rows(request: Request, body: bytes) -> Rows:
    """Rows of reports, in the form that the header says, JSON if it says none."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind == _CSV:
        try:
            return read_csv(body.decode("utf-8-sig"))
        except UnicodeDecodeError as error:
            raise InputError(f"body: byte {error.start} is not UTF-8 text") from None
    return read_json(body, lines=kind == _LINES)


async def _body(request: Request) -> bytes:
    """The body of a request, unless it is too large."""
    parts: list[bytes] = []
    size = 0
    try:
        async for part in request.stream():
            size += len(part)
            parts = [*parts, part] if size <= MAX_BODY else []
            if size > MAX_READ:
                break
    except ClientDisconnect:
        raise HTTPException(400, "the connection was closed") from None
    if size > MAX_BODY:
        raise HTTPException(413, f"the body is larger than {MAX_BODY} bytes", {"Connection": "close"})
    return b"".join(parts)


def _error(code: int, text: str, headers: Any = None) -> Response:
    return JSONResponse({"error": one_line(text)}, code, headers)
