"""Where each UAV should land next, from a table of reports: one answer, when all rows have come in."""

from typing import Any

import pandas as pd
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian import keys
from damian.common.text_files import named
from damian.field.node import Node
from damian.field.rows import Rows
from damian.field.tracker import Tracker
from damian.learners.recurrent import AgentGRU


def next_landings(
    rows: Rows, node: Node, policy: TensorDictModuleBase, now: float, drawn: bool = False
) -> pd.DataFrame:
    """Where each UAV should land next, as the policy chooses once all rows have come in.

    Columns: ``ID``; ``state``, ``fly``, ``hold``, or ``in flight``, where it goes on; ``lat``, ``lon`` [deg],
    or over a region without a place on Earth ``x``, ``y`` [m], of the landing point; ``distance`` [m] and
    ``heading``, clockwise from north [deg], from where it stands; ``age`` of its newest report [s].

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
        read: TensorDictBase = TensorDict()
        for read in tracker.steps(latest):
            if hidden is not None:
                read[keys.HIDDEN] = hidden
                hidden = policy(read.clone(False))[keys.HIDDEN]
        asking = [uav for uav in tracker.uavs if not tracker.held[uav].report.flies]
        if keys.ACTION_MASK in read.keys(True):
            read[keys.ACTION_MASK] = node.simulation.action_mask(tracker.state(asking))
        action = policy(read)[keys.ACTION]
    before, ground = tracker.state(asking), node.ground
    chooses = torch.tensor([[uav in asking for uav in tracker.uavs]])
    after = node.simulation.decide(before, action, chooses)
    answers = []
    for i, uav in enumerate(tracker.uavs):
        here, there = int(before.goal[0, i]), int(after.goal[0, i])
        answer: dict[str, Any] = {"ID": uav, "state": "in flight"}
        if uav in asking:
            answer["state"], (distance, heading) = "hold" if here == there else "fly", ground.way(here, there)
            answer |= dict(zip(ground.columns, ground.place(there), strict=True))
            answer |= {"distance": distance, "heading": None if here == there else heading}
        answers.append(answer | {"age": round(max(latest - tracker.held[uav].report.time, 0.0), 3)})
    return pd.DataFrame(answers, columns=["ID", "state", *ground.columns, "distance", "heading", "age"])
