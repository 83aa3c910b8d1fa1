"""The service over HTTP: reports in, advice out, several fleets at once. ``GET`` changes nothing.

Requests carry ``Authorization: Bearer TOKEN``; whoever has the wrong one learns nothing, not even which
fleets there are. Only the time, the health and the description of the service need none.
"""

import asyncio
import contextlib
import hmac
import logging
import time
from collections.abc import AsyncIterator, Callable
from typing import Annotated, Any

import shapely
from fastapi import APIRouter, Depends, FastAPI, HTTPException, Request, Response
from fastapi.responses import JSONResponse, PlainTextResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from pydantic import BaseModel
from starlette.exceptions import HTTPException as AnyHTTPException

import damian
from damian.common.errors import InputError, RunError
from damian.common.text_files import one_line
from damian.field.rows import Found, Report, parsed_json, rows_of_csv, rows_of_json, validated, written
from damian.show.geojson import on_earth
from damian_fleet.fleet import Waiting
from damian_fleet.map import router as map_router
from damian_fleet.rows import Acknowledgement, Advice, Asking, Change, Command, FleetStatus, Members
from damian_fleet.store import Fleets, NoFleet

MAX_BODY, TICK, JUMP = 1_000_000, 1.0, 1.0
"""Largest body of a request [bytes]; time between two updates of all fleets, so that no request waits for
many steps [s]; by how much the system clock must change against the monotonic one for a jump [s]."""
STATUS = {NoFleet: 404, Waiting: 409, InputError: 422, RunError: 507}
"""What a request is answered that ends with an error; 507: it could not be stored, and changed nothing."""
_LOG = logging.getLogger("damian_fleet")


class Clock:
    """Seconds since 1970 that never jump: the system's at the start, then by the monotonic clock.

    It starts at ``least`` [s] at least, such as the latest time that is stored. ``ahead`` is by how much the
    clock of the system was ahead of it when somebody looked last [s].
    """

    def __init__(self, least: float = 0.0, system: Any = time.time, monotonic: Any = time.monotonic) -> None:
        self._system, self._monotonic = system, monotonic
        self._base = max(system(), least) - monotonic()
        self.ahead = system() - self()

    def __call__(self) -> float:
        return self._base + self._monotonic()

    def watch(self) -> None:
        """Look at the clock of the system, and note it if it has jumped."""
        before, self.ahead = self.ahead, self._system() - self()
        if abs(self.ahead - before) > JUMP:
            _LOG.warning(
                "the system clock is now %.1f s ahead of the service, which keeps its time", self.ahead
            )


def status_of(error: Exception) -> int:
    """The HTTP status of an error."""
    return next((status for kind, status in STATUS.items() if isinstance(error, kind)), 500)


def refused(_: Request, error: Exception) -> Response:
    """An error as one line."""
    if isinstance(error, AnyHTTPException):
        return JSONResponse({"error": str(error.detail)}, error.status_code, error.headers)
    return JSONResponse({"error": one_line(str(error))}, status_of(error))


async def check_size(request: Request) -> None:
    """Refuse a large body before it is read."""
    length = request.headers.get("content-length", "0" if request.method in ("GET", "DELETE") else "")
    if not length.isdecimal():
        raise HTTPException(411, "say how long the body is: Content-Length")
    if int(length) > MAX_BODY:
        raise HTTPException(413, f"the body is larger than {MAX_BODY} bytes", {"Connection": "close"})


async def rows_of(request: Request) -> Found:
    """The rows of a body, JSON (one object or a list) or CSV."""
    body = await request.body()
    is_table = request.headers.get("content-type", "").startswith("text/csv")
    return rows_of_csv(body.decode("utf-8-sig", "replace")) if is_table else rows_of_json(body)


def body_of(model: type[BaseModel]) -> Any:
    """A body as a model, whatever type of content the request names."""

    async def read(request: Request) -> BaseModel:
        return validated(model, parsed_json(await request.body() or b"{}"))

    return Depends(read)


def described(model: type[BaseModel], rows: bool = False) -> dict[str, Any]:
    """How OpenAPI describes a body; ``rows``: one of these objects, a list of them, or a table."""
    one, table = model.model_json_schema(), {"text/csv": {"schema": {"type": "string"}}} if rows else {}
    schema = {"anyOf": [one, {"type": "array", "items": one}]} if rows else one
    return {"requestBody": {"required": True, "content": {"application/json": {"schema": schema}, **table}}}


Rows = Annotated[Found, Depends(rows_of)]


def make_app(fleets: Fleets, token: str, clock: Callable[[], float] | None = None) -> FastAPI:
    """The service as an ASGI application; ``clock`` tells its time [s since 1970]."""
    now = clock or Clock(fleets.latest)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        ticking = asyncio.create_task(_tick(fleets, now))
        yield
        ticking.cancel()

    app = FastAPI(title="damian-fleet", version=damian.__version__, lifespan=lifespan)
    for kind in (AnyHTTPException, InputError, RunError):
        app.add_exception_handler(kind, refused)

    @app.get("/health")
    async def health(response: Response) -> dict[str, Any]:
        """Whether requests can be stored (503 if not)."""
        response.status_code = 503 if fleets.problem else 200
        said = {"status": "failing" if fleets.problem else "ok", "problem": fleets.problem}
        return {**said, "fleets": len(fleets.names), "version": damian.__version__}

    @app.get("/time")
    async def service_time() -> dict[str, Any]:
        """The time of the service, and how far the clock of its system is ahead [s]."""
        ahead = now.ahead if isinstance(now, Clock) else 0.0
        return {"time": now(), "written": written(now()), "system_ahead": round(ahead, 3)}

    app.include_router(map_router)
    app.include_router(_fleets(fleets, token, now))
    return app


def _fleets(fleets: Fleets, token: str, now: Callable[[], float]) -> APIRouter:
    """The requests about fleets."""
    bearer = HTTPBearer(auto_error=False)

    async def check_token(given: Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)]) -> None:
        if not hmac.compare_digest((given.credentials if given else "").encode(), token.encode()):
            raise HTTPException(401, "the token is missing or wrong", {"WWW-Authenticate": "Bearer"})

    router = APIRouter(prefix="/fleets", dependencies=[Depends(check_token), Depends(check_size)])

    @router.get("")
    async def names() -> dict[str, list[str]]:
        """The fleets."""
        return {"fleets": fleets.names}

    @router.put("/{name}", openapi_extra=described(Members))
    async def create(name: str, members: Annotated[Members, body_of(Members)], response: Response) -> Members:
        """Create a fleet (201), or find it (200)."""
        response.status_code = 201 if fleets.create(name, members.uavs) else 200
        return members

    @router.get("/{name}", response_model_exclude_unset=True)
    async def status(name: str) -> FleetStatus:
        """What is known of a fleet."""
        return fleets.status(name, now())

    @router.delete("/{name}", status_code=204)
    async def end(name: str) -> None:
        """End a fleet; what happened to it is kept."""
        fleets.end(name, now())

    @router.post("/{name}/reports", openapi_extra=described(Report, rows=True))
    async def reports(name: str, rows: Rows) -> dict[str, Any]:
        """Take reports; each is ``new``, ``late``, a ``duplicate`` or too ``old``."""
        return fleets.report(name, rows, now())

    @router.post("/{name}/advice", openapi_extra=described(Asking), response_model_exclude_unset=True)
    async def advise(name: str, asking: Annotated[Asking, body_of(Asking)]) -> dict[str, list[Advice]]:
        """Let UAVs choose, and tell them."""
        return {"advice": fleets.advise(name, asking.uavs, now())}

    @router.post("/{name}/acknowledgements", openapi_extra=described(Acknowledgement, rows=True))
    async def acknowledge(name: str, rows: Rows) -> dict[str, list[str]]:
        """Take what UAVs do with answers; how far these have come."""
        return {"status": fleets.acknowledge(name, rows, now())}

    @router.post("/{name}/command", openapi_extra=described(Command))
    async def command(name: str, said: Annotated[Command, body_of(Command)]) -> dict[str, list[str]]:
        """Hold, resume or return UAVs."""
        return {"uavs": fleets.command(name, said.command, said.uavs, now())}

    @router.post("/{name}/uavs", openapi_extra=described(Change))
    async def change(name: str, said: Annotated[Change, body_of(Change)]) -> dict[str, list[str]]:
        """Let UAVs join and leave."""
        return {"uavs": fleets.change_members(name, said.join, said.leave, now())}

    @router.get("/{name}/geofence")
    async def geofence(name: str) -> dict[str, Any]:
        """The region as a GeoJSON feature, with its landing points."""
        ground = fleets.fleet(name).ground
        region = ground.region
        if region.origin is None:
            raise InputError(f"geofence: {region.name} has no place on Earth")
        points = on_earth(shapely.MultiPoint(ground.points.tolist()), region.origin)["coordinates"]
        shape = on_earth(region.polygon, region.origin)
        about = {"name": region.name, "landing_points": points}
        return {"type": "Feature", "properties": about, "geometry": shape}

    @router.get("/{name}/journal", response_class=PlainTextResponse)
    async def journal(name: str) -> str:
        """What happened to the fleet, as a journal for ``damian fly`` and ``damian advise``."""
        return "\n".join([*fleets.journal(name), ""])

    return router


async def _tick(fleets: Fleets, now: Callable[[], float]) -> None:
    """Let the fleets take their steps, one fleet at a time, so that requests come in between."""
    while True:
        if isinstance(now, Clock):
            now.watch()
        for name, fleet in [*fleets.loaded.items()]:
            try:
                fleet.advance(now())
            except Exception:  # of one fleet: the others go on
                _LOG.exception("fleet %s could not be brought up to date", name)
            await asyncio.sleep(0)
        await asyncio.sleep(TICK)
