"""The server node of a fleet of real UAVs: their reports come in, and where each should land goes out."""

from importlib.util import find_spec

from damian.common.errors import InputError

if find_spec("pydantic") is None:
    raise InputError("advice for real UAVs: pydantic is not installed; pip install 'damian[advise]'")
