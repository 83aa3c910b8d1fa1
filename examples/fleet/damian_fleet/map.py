"""The map of a fleet: a page that asks for the token, and draws with the modules of the replay page."""

import json
from pathlib import Path

from fastapi import APIRouter, HTTPException
from fastapi.responses import FileResponse, HTMLResponse

from damian.common.plotting import UAV_COLOURS
from damian.show.replay_page import PAGE

router = APIRouter()
_MAP = Path(__file__).with_name("map.html")


@router.get("/fleets/{name}/map", response_class=HTMLResponse)
async def show_map(name: str) -> HTMLResponse:
    """The fleet as it flies, in a browser; what it shows, it asks for with the token that one types in."""
    return HTMLResponse(_MAP.read_text(encoding="utf-8").replace("$colours", json.dumps(UAV_COLOURS)))


@router.get("/page/{name}", include_in_schema=False)
async def part(name: str) -> FileResponse:
    """A module or the style of the replay page."""
    path = PAGE / (name if name.endswith(".css") else f"{name}.js")
    if path not in {*PAGE.iterdir()}:
        raise HTTPException(404, "the map has no file of this name")
    return FileResponse(path)
