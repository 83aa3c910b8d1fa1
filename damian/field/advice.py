"""Where each UAV should land next, from a table of reports: one answer, when all rows have come in."""

import math
from collections.abc import Sequence
from typing import Literal

import torch
from pydantic import BaseModel
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian import keys
from damian.common.errors import InputError
from damian.common.text_files import listed, named
from damian.field.node import Node
from damian.field.rows import Rows
from damian.field.tracker import Tracker
from damian.learners.recurrent import AgentGRU


class NextLanding(BaseModel):
    """Where a UAV should land next; a UAV in flight goes on to where it flies."""

    ID: str
    state: Literal["fly", "hold", "in flight"]
    lat: float | None = None
    lon: float | None = None
    """Landing point [deg]; over a region without a place on Earth ``x``, ``y`` [m]; None in flight."""
    x: float | None = None
    y: float | None = None
    distance: float | None = None
    """From where it stands [m]."""
    heading: float | None = None
    """Clockwise from north [deg]."""
    age: float
    """Age of its newest report [s]."""


def next_landings(
    rows: Rows, node: Node, policy: TensorDictModuleBase, now: float, drawn: bool = False
) -> list[NextLanding]:
    """What the policy chooses for each UAV once all rows have come in.

    A row that does not say when it came in came in ``now`` [s since 1970]. With ``drawn``, actions are drawn
    from torch's generator; if not, the most likely ones are taken.
    """
    for where, report in rows:
        with named(where):
            report.stamp(now, file=True)
    tracker = Tracker([*dict.fromkeys(report.id for _, report in rows)], lambda _: node)
    sizes = [each.cell.hidden_size for each in policy.modules() if isinstance(each, AgentGRU)]
    hidden = torch.zeros(1, len(tracker.uavs), sizes[0]) if sizes else None
    kind = ExplorationType.RANDOM if drawn else ExplorationType.DETERMINISTIC
    with torch.no_grad(), set_exploration_type(kind):
        for where, report in sorted(rows, key=lambda row: row[1].received):
            for _ in tracker.advance(report.received, math.inf if hidden is None else 0):
                hidden = policy(_read(tracker, [], hidden))[keys.HIDDEN]
            with named(where):
                tracker.report(report)
        if tracker.start is None:
            raise InputError(f"no report of {listed(tracker.missing)} is there")
        asking = [uav for uav in tracker.uavs if not tracker.held[uav].report.flies]
        action = policy(_read(tracker, asking, hidden))[keys.ACTION]
    return _answers(tracker, asking, action)


def _read(tracker: Tracker, asking: Sequence[str], hidden: Tensor | None) -> TensorDictBase:
    """What the policy reads, if these UAVs are ready to choose."""
    read = tracker.observe().clone(False)
    if keys.ACTION_MASK in read.keys(True):
        read[keys.ACTION_MASK] = tracker.node.simulation.action_mask(tracker.state(asking))
    return read if hidden is None else read.set(keys.HIDDEN, hidden)


def _answers(tracker: Tracker, asking: Sequence[str], action: Tensor) -> list[NextLanding]:
    """The landing points to which actions [1, N, ...] lead; only those of the UAVs that ask count."""
    before, ground = tracker.state(asking), tracker.node.ground
    chooses = torch.tensor([[uav in asking for uav in tracker.uavs]])
    after = tracker.node.simulation.decide(before, action, chooses)
    answers = []
    for i, uav in enumerate(tracker.uavs):
        here, there = int(before.goal[0, i]), int(after.goal[0, i])
        where = dict.fromkeys((*ground.columns, "distance", "heading"))
        state = "in flight"
        if uav in asking:
            state, (distance, heading) = "hold" if here == there else "fly", ground.way(here, there)
            where |= dict(zip(ground.columns, ground.place(there), strict=True))
            where |= {"distance": distance, "heading": None if here == there else heading}
        age = round(max(tracker.clock - tracker.held[uav].report.time, 0.0), 3)
        answers.append(NextLanding(ID=uav, state=state, **where, age=age))
    return answers
