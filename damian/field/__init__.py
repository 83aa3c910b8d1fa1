"""Reports of real UAVs: their delays, the flight that they tell, and where each UAV should land next."""

from importlib.util import find_spec

from damian.common.errors import InputError

if find_spec("pydantic") is None:
    raise InputError("reports of real UAVs: pydantic is not installed; pip install 'damian[advise]'")
