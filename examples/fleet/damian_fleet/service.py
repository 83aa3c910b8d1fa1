"""The service over HTTP: reports in, advice out, several fleets at once. ``GET`` changes nothing.

Requests carry ``Authorization: Bearer TOKEN``; whoever has the wrong one learns nothing, not even
which fleets there are. Only the time, the health and the description of the service, and the page
of the map without its data, need none.
"""

import asyncio
import contextlib
import hmac
import json
import logging
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Annotated, Any

import shapely
from fastapi import APIRouter, Depends, FastAPI, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, PlainTextResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from pydantic import BaseModel
from starlette.exceptions import HTTPException as AnyHTTPException

import damian
from damian.common.errors import InputError, RunError
from damian.common.plotting import UAV_COLOURS
from damian.common.text_files import one_line, show
from damian.show.replay_page import PAGE
from damian_fleet.fleet import Fleet, Held, Waiting
from damian_fleet.reports import (
    Found,
    Report,
    reports_of,
    rows_of_csv,
    rows_of_json,
    validated,
    written,
)
from damian_fleet.rows import (
    MOST_ROWS,
    Acknowledgement,
    Advice,
    Asking,
    Change,
    Command,
    FleetStatus,
    Members,
)
from damian_fleet.store import Fleets, NoFleet

MAX_BODY, TICK = 1_000_000, 1.0
"""Largest body of a request [bytes]; time between two updates of all fleets, so that no request
waits for many steps [s]."""
STATUS = {
    NoFleet: 404,
    Waiting: 409,
    Held: 409,
    InputError: 422,
    RequestValidationError: 422,
    RunError: 507,
}
"""What a request is answered that ends with an error; 507: it could not be stored, and changed
nothing."""
_LOG = logging.getLogger("damian_fleet")


class Clock:
    """Seconds since 1970 that never jump: the system's at the start, then by the monotonic clock.

    It starts at ``least`` [s] at least, such as the latest time that is stored.
    """

    def __init__(
        self, least: float = 0.0, system: Any = time.time, monotonic: Any = time.monotonic
    ) -> None:
        self._system = system
        self._monotonic = monotonic
        self._base = max(system(), least) - monotonic()

    def __call__(self) -> float:
        return self._base + self._monotonic()

    @property
    def system_ahead(self) -> float:
        """By how much the clock of the system is ahead, because it was set [s]."""
        return self._system() - self()


def refused(_: Request, error: Any) -> Response:
    """An error as one line."""
    if isinstance(error, AnyHTTPException):
        return JSONResponse({"error": str(error.detail)}, error.status_code, error.headers)
    text = str(error)
    if isinstance(error, RequestValidationError):
        first = error.errors()[0]
        text = f"{'.'.join(map(str, first['loc'][1:]))}: {show(first['input'])}: {first['msg']}"
    status = next(status for kind, status in STATUS.items() if isinstance(error, kind))
    return JSONResponse({"error": one_line(text)}, status)


async def check_size(request: Request) -> None:
    """Refuse a large body before it is read."""
    length = request.headers.get(
        "content-length", "0" if request.method in ("GET", "DELETE") else ""
    )
    if not length.isdecimal():
        raise HTTPException(411, "say how long the body is: Content-Length")
    if int(length) > MAX_BODY:
        raise HTTPException(
            413, f"the body is larger than {MAX_BODY} bytes", {"Connection": "close"}
        )


async def rows_of(request: Request) -> Found:
    """The rows of a body, JSON (one object or a list) or CSV."""
    body = await request.body()
    is_table = request.headers.get("content-type", "").startswith("text/csv")
    if is_table and body.count(b"\n") > MOST_ROWS + 1:
        raise HTTPException(
            413, f"there are more than {MOST_ROWS} rows: send them in several requests"
        )
    found = rows_of_csv(body.decode("utf-8-sig", "replace")) if is_table else rows_of_json(body)
    if not found:
        raise InputError("there are no rows")
    if len(found) > MOST_ROWS:
        raise HTTPException(
            413, f"there are more than {MOST_ROWS} rows: send them in several requests"
        )
    return found


def rows_as(model: type[BaseModel]) -> dict[str, Any]:
    """How OpenAPI describes a body of rows: one of these objects, a list of them, or a table."""
    one = model.model_json_schema()
    row = {"schema": {"anyOf": [one, {"type": "array", "items": one}]}}
    content = {"application/json": row, "text/csv": {"schema": {"type": "string"}}}
    return {"requestBody": {"required": True, "content": content}}


Rows = Annotated[Found, Depends(rows_of)]


def make_app(fleets: Fleets, token: str, clock: Clock | None = None) -> FastAPI:
    """The service as an ASGI application."""
    now = clock or Clock(fleets.latest)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        ticking = asyncio.create_task(_tick(fleets, now))
        yield
        ticking.cancel()

    app = FastAPI(title="damian-fleet", version=damian.__version__, lifespan=lifespan)
    for kind in (AnyHTTPException, *STATUS):
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
        return {
            "time": now(),
            "written": written(now()),
            "system_ahead": round(now.system_ahead, 3),
        }

    @app.get("/fleets/{name}/map", response_class=HTMLResponse)
    async def show_map(name: str) -> str:
        """The fleet as it flies; the page asks for what it shows with the token that one types
        in."""
        page = Path(__file__).with_name("map.html").read_text(encoding="utf-8")
        return page.replace("$colours", json.dumps(UAV_COLOURS))

    @app.get("/page/{name}", include_in_schema=False)
    async def part(name: str) -> FileResponse:
        """A module or the style of the replay page, with which the map is drawn."""
        path = PAGE / (name if name.endswith(".css") else f"{name}.js")
        if path not in {*PAGE.iterdir()}:
            raise HTTPException(404, "the map has no file of this name")
        return FileResponse(path)

    app.include_router(_fleets(fleets, token, now))
    return app


def _fleets(fleets: Fleets, token: str, now: Clock) -> APIRouter:
    """The requests about fleets."""
    bearer = HTTPBearer(auto_error=False)

    async def check_token(
        given: Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)],
    ) -> None:
        if not hmac.compare_digest((given.credentials if given else "").encode(), token.encode()):
            raise HTTPException(
                401, "the token is missing or wrong", {"WWW-Authenticate": "Bearer"}
            )

    router = APIRouter(prefix="/fleets", dependencies=[Depends(check_token), Depends(check_size)])

    @router.get("")
    async def names() -> dict[str, list[str]]:
        """The fleets."""
        return {"fleets": fleets.names}

    @router.put("/{name}")
    async def create(name: str, said: Members, response: Response) -> Members:
        """Create a fleet (201), or find it (200)."""
        response.status_code = 201 if fleets.create(name, said.uavs) else 200
        return said

    @router.get("/{name}", response_model_exclude_unset=True)
    async def status(name: str) -> FleetStatus:
        """What is known of a fleet."""
        return fleets[name].status(now())

    @router.delete("/{name}", status_code=204)
    async def end(name: str) -> None:
        """End a fleet; what happened to it is kept."""
        fleets.end(name, now())

    @router.post("/{name}/reports", openapi_extra=rows_as(Report))
    async def report(name: str, rows: Rows) -> dict[str, Any]:
        """Take reports, all or none; each is ``new``, ``late``, a ``duplicate`` or too ``old``."""
        reports = reports_of(rows)
        ignored = {column for _, report in reports for column in report.model_extra or ()}
        found = fleets.take(name, Fleet.reported, reports, now())
        told = {
            "accepted": len(found),
            "found": found,
            "ignored": sorted(ignored - {"bridge", "vehicle"}),
        }
        warning = fleets[name].warnings({report.id for _, report in reports})
        return {**told, "warning": warning} if warning else told

    @router.post("/{name}/advice", response_model_exclude_unset=True)
    async def advise(name: str, said: Asking) -> dict[str, list[Advice]]:
        """Let UAVs choose, and tell them."""
        fleets.take(name, Fleet.advised, said, now())
        return {"advice": fleets[name].advice(said)}

    @router.post("/{name}/acknowledgements", openapi_extra=rows_as(Acknowledgement))
    async def acknowledge(name: str, rows: Rows) -> dict[str, list[str]]:
        """Take what UAVs do with answers, all or none; how far these have come, or ``unknown``."""
        said = [validated(Acknowledgement, row, where) for where, row in rows]
        return {"status": fleets.take(name, Fleet.acknowledged, said, now())}

    @router.post("/{name}/command")
    async def command(name: str, said: Command) -> dict[str, list[str]]:
        """Hold, resume or return UAVs."""
        return {"uavs": fleets.take(name, Fleet.commanded, said, now())}

    @router.post("/{name}/uavs")
    async def change(name: str, said: Change) -> dict[str, list[str]]:
        """Let UAVs join and leave; the members from now on."""
        return {"uavs": fleets.take(name, Fleet.changed, said, now())}

    @router.get("/{name}/geofence")
    async def geofence(name: str) -> dict[str, Any]:
        """The region as a GeoJSON feature, with its landing points."""
        ground = fleets[name].ground
        points = ground.on_earth(shapely.MultiPoint(ground.points.tolist()))["coordinates"]
        about = {"name": ground.region.name, "landing_points": points}
        shape = ground.on_earth(ground.region.polygon)
        return {"type": "Feature", "properties": about, "geometry": shape}

    @router.get("/{name}/journal", response_class=PlainTextResponse)
    async def journal(name: str) -> str:
        """What happened to the fleet, as a journal for ``damian-playback`` and ``damian fit``."""
        return "\n".join([*fleets.journal(name), ""])

    return router


async def _tick(fleets: Fleets, now: Clock) -> None:
    """Let the fleets take their steps, one fleet at a time, so that requests come in between."""
    while True:
        for name, fleet in [*fleets.loaded.items()]:
            try:
                fleet.advance(now())
            except Exception:  # of one fleet: the others go on
                _LOG.exception("fleet %s could not be brought up to date", name)
            await asyncio.sleep(0)
        await asyncio.sleep(TICK)
