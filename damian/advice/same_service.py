"""Whether a journal is of a service like this one: the same policy, and the same settings.

A journal keeps actions and steps, which mean something else with another lattice, other actions or another
length of a step: a UAV would count as bound for where nobody has sent it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from damian.advice.fleet import Fleet
from damian.common.errors import InputError
from damian.common.text_files import show

SERVICE = ("reports", "folder", "port", "host", "token", "uavs", "journal", "durable")
"""Settings that say how reports come in and where journals lie."""
FREE = (*SERVICE, "policy", "checkpoint", "agents", "device", "frames", "episodes", "eval_episodes", "hydra")
"""Settings that need not be the same: those, what is compared apart, and what no advice follows from."""
NEAR = 0.01
"""Distance within which two places are the same [m]: those in journals are rounded to a millimetre."""


def check_same(was: Any, own: Mapping[str, Any]) -> None:
    """Check that a journal is of the policy and of the settings of this service.

    Args:
        was: what the journal tells of its service: ``policy``, ``checkpoint`` and ``overrides``.
        own: the same of this service.

    Raises:
        InputError: it is of others.
    """
    was = was if isinstance(was, dict) else {}
    then, now = ({name: each.get(name) for name in ("policy", "checkpoint")} for each in (was, own))
    remedy = "name another journal=FOLDER"
    if then != now:
        raise InputError(f"it is of {show(then)}, not of {show(now)}: {remedy}")
    words = was.get("overrides") or []
    if not isinstance(words, list) or not all(isinstance(word, str) for word in words):
        raise InputError(f"it is damaged: overrides: {show(words)} is not a list of settings")
    then, now = settings_of(words), settings_of(own.get("overrides") or [])
    differ = [key for key in {**then, **now} if then.get(key) != now.get(key)]
    if differ:
        each = (f"{key}: {_shown(then, key)} then, {_shown(now, key)} now" for key in differ)
        raise InputError(f"it is of other settings: {'; '.join(each)}: give the same, or {remedy}")


def settings_of(overrides: Sequence[str]) -> dict[str, str]:
    """What overrides set, by key, without what is free to change; the last one of a key counts."""
    parts = [word.lstrip("+").partition("=") for word in overrides]
    return {key: value for key, _, value in parts if key.split(".")[0] not in FREE}


def _shown(settings: Mapping[str, str], key: str) -> str:
    return settings.get(key, "not given")


def check_goals(fleet: Fleet, entry: Mapping[str, Any]) -> None:
    """Check that a line of a journal, which has been replayed, sends UAVs where they were sent.

    Raises:
        InputError: a UAV was told another landing point than its action leads to with these settings.
    """
    told, advice = entry.get("told"), entry.get("advice")
    if not isinstance(told, dict) or not isinstance(advice, list):
        return
    rows = {str(row.get("ID")): row for row in advice if isinstance(row, dict)}
    for uav in told:
        row, decision = rows.get(uav, {}), fleet.decision(fleet.number[uav])
        first, second = (row.get(column) for column in fleet.ground.columns)
        if decision is None or not (isinstance(first, int | float) and isinstance(second, int | float)):
            raise InputError(f"it is damaged: {show(row)} does not say where {uav} was sent")
        away = float(np.hypot(*(fleet.ground.points[decision.goal] - fleet.ground.local((first, second)))))
        if not away <= NEAR:
            wrong = f"{uav} was sent to {first:.10g}, {second:.10g}, {away:.2f} m from where its action leads"
            raise InputError(f"it is damaged, or of another region, lattice or actions: {wrong}")
