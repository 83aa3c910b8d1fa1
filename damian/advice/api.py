"""Requests and answers of the service as pydantic models, and their description as OpenAPI 3.1."""

from html import escape
from typing import Any, Literal, NamedTuple

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from damian.advice.journal import Change, Command
from damian.advice.rows import Acknowledgement, Advice, FleetStatus, Report


class NewFleet(BaseModel):
    """UAVs of a fleet to create or find."""

    uavs: list[str]


class Fleet(BaseModel):
    """A fleet and its UAVs."""

    fleet: str
    uavs: list[str]


class Fleets(BaseModel):
    """Names of all fleets."""

    fleets: list[str]


class Taken(BaseModel):
    """What became of reports: ``new``, ``late``, ``duplicate`` or ``old``, and columns not understood."""

    accepted: int
    found: list[str]
    ignored: list[str] = []


class Acknowledged(BaseModel):
    """How far each answer has come; ``unknown`` if there is no such answer to this UAV."""

    status: list[str]


class Answers(BaseModel):
    """What the UAVs are told."""

    fleet: str
    advice: list[Advice]


class ServiceTime(BaseModel):
    """The time of the service, which UAVs can set their clocks by."""

    time: float
    """Seconds since 1970."""
    written: str | float
    system_ahead: float
    """How far the system clock is ahead [s]."""
    jumps: int
    """How many times the system clock has jumped."""


class Health(BaseModel):
    """Whether the service can keep what it acknowledges."""

    status: Literal["ok", "failing"]
    problem: str | None
    fleets: int
    version: str


class Error(BaseModel):
    """Why a request was refused, in one line."""

    error: str


class Endpoint(NamedTuple):
    """A request that the service answers."""

    method: str
    path: str
    name: str
    """Name of the method of ``Service`` that answers it."""
    summary: str
    answer: type[BaseModel] | None
    """None: no JSON of these models."""
    body: type[BaseModel] | None = None
    rows: bool = False
    """Whether the body is one of these objects or a list of them, or a CSV table."""
    query: tuple[str, ...] = ()
    is_open: bool = False
    """Whether it needs no token."""


_FLEET = "/fleets/{name}"
ENDPOINTS = (
    Endpoint("GET", "/", "page", "this page", None, is_open=True),
    Endpoint("GET", "/openapi.json", "openapi", "this description as OpenAPI 3.1", None, is_open=True),
    Endpoint("GET", "/health", "health", "whether it can keep reports (503 if not)", Health, is_open=True),
    Endpoint("GET", "/time", "time", "the time of the service", ServiceTime, is_open=True),
    Endpoint("GET", "/fleets", "list", "the fleets", Fleets),
    Endpoint("PUT", _FLEET, "put", "creates a fleet (201), or finds it (200)", Fleet, NewFleet),
    Endpoint("GET", _FLEET, "get", "what is known of a fleet", FleetStatus),
    Endpoint("DELETE", _FLEET, "delete", "ends a fleet; its journal is kept", None),
    Endpoint("POST", f"{_FLEET}/reports", "reports", "takes reports", Taken, Report, rows=True),
    Endpoint("GET", f"{_FLEET}/advice", "advice", "advises UAVs", Answers, query=("uav", "format")),
    Endpoint("GET", f"{_FLEET}/events", "events", "the same as server-sent events", None, query=("uav",)),
    Endpoint(
        "POST",
        f"{_FLEET}/acknowledgements",
        "acknowledge",
        "takes what UAVs do with answers",
        Acknowledged,
        Acknowledgement,
        rows=True,
    ),
    Endpoint("POST", f"{_FLEET}/command", "command", "holds, resumes or returns UAVs", Fleet, Command),
    Endpoint("POST", f"{_FLEET}/uavs", "members", "lets UAVs join and leave", Fleet, Change),
    Endpoint("GET", f"{_FLEET}/geofence", "geofence", "the region as a GeoJSON feature", None),
)


def openapi(version: str) -> dict[str, Any]:
    """The description of all requests; ``version`` is that of the service."""
    models = {model for each in ENDPOINTS for model in (each.answer, each.body) if model} | {Error}
    ordered = sorted(models, key=lambda model: model.__name__)
    template = "#/components/schemas/{model}"
    refs, schemas = models_json_schema([(model, "validation") for model in ordered], ref_template=template)
    paths: dict[str, Any] = {}
    for each in ENDPOINTS:
        answer = {"application/json": {"schema": refs[each.answer, "validation"]}} if each.answer else {}
        told: dict[str, Any] = {
            "summary": each.summary,
            "operationId": each.name,
            "parameters": [
                {"name": name, "in": kind, "required": kind == "path", "schema": {"type": "string"}}
                for kind, names in (("path", ("name",) * ("{name}" in each.path)), ("query", each.query))
                for name in names
            ],
            "responses": {
                "2XX": {"description": "done", "content": answer},
                "default": {
                    "description": "refused",
                    "content": {"application/json": {"schema": refs[Error, "validation"]}},
                },
            },
            "security": [] if each.is_open else [{"token": []}],
        }
        if each.body:
            one = refs[each.body, "validation"]
            body = {"oneOf": [one, {"type": "array", "items": one}]} if each.rows else one
            content: dict[str, Any] = {"application/json": {"schema": body}}
            content |= {"text/csv": {"schema": {"type": "string"}}} if each.rows else {}
            told["requestBody"] = {"required": True, "content": content}
        paths.setdefault(each.path, {})[each.method.lower()] = told
    return {
        "openapi": "3.1.0",
        "info": {"title": "damian advise", "version": version},
        "paths": paths,
        "components": {
            "schemas": schemas["$defs"],
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
    }


def page() -> str:
    """The requests as a page that loads nothing from elsewhere."""
    rows = "".join(
        f"<tr><td>{each.method}<td><code>{escape(each.path)}</code><td>{escape(each.summary)}"
        for each in ENDPOINTS
    )
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>damian advise</title>'
        f'<h1>damian advise</h1><table>{rows}</table><p><a href="openapi.json">OpenAPI</a></p></html>'
    )
