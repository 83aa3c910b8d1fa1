"""Where each UAV should land next, from a table of reports: one answer, when all rows have come in."""

from collections.abc import Sequence
from typing import Literal

import torch
from pydantic import BaseModel
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian import keys
from damian.common.text_files import named
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
    tracker = Tracker(node, [*dict.fromkeys(report.id for _, report in rows)], rows)
    latest = max(report.received for _, report in rows)
    sizes = [each.cell.hidden_size for each in policy.modules() if isinstance(each, AgentGRU)]
    hidden = torch.zeros(1, len(tracker.uavs), sizes[0]) if sizes else None
    kind = ExplorationType.RANDOM if drawn else ExplorationType.DETERMINISTIC
    with torch.no_grad(), set_exploration_type(kind):
        for outputs in tracker.steps(latest):
            read = outputs if hidden is None else outputs.set(keys.HIDDEN, hidden)
            if hidden is not None:
                hidden = policy(read.clone(False))[keys.HIDDEN]
        asking = [uav for uav in tracker.uavs if not tracker.held[uav].report.flies]
        if keys.ACTION_MASK in read.keys(True):
            read[keys.ACTION_MASK] = node.simulation.action_mask(tracker.state(asking))
        return _answers(tracker, asking, policy(read)[keys.ACTION], latest)


def _answers(tracker: Tracker, asking: Sequence[str], action: Tensor, now: float) -> list[NextLanding]:
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
        age = round(max(now - tracker.held[uav].report.time, 0.0), 3)
        answers.append(NextLanding(ID=uav, state=state, **where, age=age))
    return answers
