"""Requests and answers of the service as pydantic models, and their description as OpenAPI 3.1."""

from html import escape
from typing import Any, NamedTuple

from pydantic import BaseModel, create_model
from pydantic.json_schema import models_json_schema

from damian.field.rows import Report
from damian_fleet.answers import Acknowledgement, Advice, FleetStatus
from damian_fleet.journal import Change, Command

NewFleet = create_model("NewFleet", uavs=(list[str], ...), __doc__="UAVs of a fleet to create or find.")
Fleet = create_model("Fleet", fleet=(str, ...), uavs=(list[str], ...))
Fleets = create_model("Fleets", fleets=(list[str], ...))
Answers = create_model("Answers", fleet=(str, ...), advice=(list[Advice], ...))
Error = create_model("Error", error=(str, ...), __doc__="Why a request was refused, in one line.")
_MEANS = "New, late, duplicate or old, for each report; and columns that are not understood."
_PARTS: Any = {"accepted": (int, ...), "found": (list[str], ...), "ignored": (list[str], [])}
Taken = create_model("Taken", **_PARTS, __doc__=_MEANS)
_MEANS = "How far each answer has come; unknown if there is no such answer to this UAV."
Acknowledged = create_model("Acknowledged", status=(list[str], ...), __doc__=_MEANS)
_MEANS = "Seconds since 1970, also as text; how far the system clock is ahead [s], how often it has jumped."
_PARTS = {
    "time": (float, ...),
    "written": (str | float, ...),
    "system_ahead": (float, ...),
    "jumps": (int, ...),
}
ServiceTime = create_model("ServiceTime", **_PARTS, __doc__=_MEANS)
_MEANS = "Whether the service is ok or failing to write journals, and why."
_PARTS = {"status": (str, ...), "problem": (str | None, ...), "fleets": (int, ...), "version": (str, ...)}
Health = create_model("Health", **_PARTS, __doc__=_MEANS)


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
        "info": {"title": "damian-fleet", "version": version},
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
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>damian-fleet</title>'
        f'<h1>damian-fleet</h1><table>{rows}</table><p><a href="openapi.json">OpenAPI</a></p></html>'
    )
