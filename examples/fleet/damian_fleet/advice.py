"""Where each UAV should land next, from what UAVs report."""

from collections.abc import Callable, Sequence
from typing import Any

import pandas as pd
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian import keys
from damian.common.text_files import named
from damian.models.memory import AgentGRU
from damian_fleet.clocks import wrong_clocks
from damian_fleet.node import Node
from damian_fleet.reports import Rows
from damian_fleet.tracker import Tracker

Policy = Callable[[TensorDictBase], TensorDictBase]


class Adviser(Tracker):
    """A tracker that asks a policy, and keeps its hidden states.

    With ``drawn``, actions are drawn from torch's generator; if not, the most likely ones are
    taken. Other arguments as of ``Tracker``.
    """

    def __init__(
        self, node: Node, uavs: Sequence[str], policy: Policy, drawn: bool = False, **more: Any
    ) -> None:
        self.policy = policy
        self.kind = ExplorationType.RANDOM if drawn else ExplorationType.DETERMINISTIC
        modules = policy.modules() if isinstance(policy, torch.nn.Module) else ()
        sizes = [each.cell.hidden_size for each in modules if isinstance(each, AgentGRU)]
        self._start = torch.zeros(1, len(uavs), sizes[0]) if sizes else None
        self.hidden, self._hidden_after = self._start, self._start
        """Hidden states before this step, [1, N, H]; None if the policy has none."""
        super().__init__(node, uavs, **more)

    def read(self, asking: Sequence[str]) -> TensorDictBase:
        """The observation that the policy gets in this step; the UAVs that ask are ready to
        choose."""
        read = self.observe().clone(False)
        if keys.ACTION_MASK in read.keys(True):
            read[keys.ACTION_MASK] = self.node.simulation.action_mask(self.state(asking))
        if self.hidden is not None:
            read[keys.HIDDEN] = self.hidden.clone()
        return read

    @torch.no_grad()
    def ask(self, asking: Sequence[str]) -> Tensor:
        """The policy's actions of all UAVs, [1, N, ...]; use those of the UAVs that ask."""
        with set_exploration_type(self.kind):
            chosen = self.policy(self.read(asking))
        self._hidden_after = None if self.hidden is None else chosen[keys.HIDDEN].detach()
        return chosen[keys.ACTION]

    def next_step(self) -> None:
        if self.hidden is not None and self._hidden_after is self.hidden:
            self.ask([])  # hidden states change in every step
        super().next_step()
        self.hidden = self._hidden_after

    def begin_anew(self, step: int) -> None:
        super().begin_anew(step)
        self.hidden = self._hidden_after = self._start


def next_landings(
    rows: Rows, node: Node, policy: Policy, now: float, drawn: bool = False
) -> pd.DataFrame:
    """Where each UAV should land next, as the policy chooses once all rows have come in.

    Columns: ``ID``; ``state``, ``fly``, ``hold``, or ``in flight``, where it goes on; ``lat``,
    ``lon`` [deg], or over a region without a place on Earth ``x``, ``y`` [m], of the landing point;
    ``distance`` [m] and ``heading``, clockwise from north [deg], from where it stands; ``age`` of
    its newest report [s].

    A row that does not say when it came in came in ``now`` [s since 1970]. ``drawn`` as of
    ``Adviser``.
    """
    for where, report in rows:
        with named(where):
            report.stamp(now, file=True)
    uavs = [*dict.fromkeys(report.id for _, report in rows)]
    wrong, _ = wrong_clocks(rows)
    rows = [row for number, row in enumerate(rows) if number not in wrong]
    adviser = Adviser(node, uavs, policy, drawn, rows=rows)
    latest = max(report.received for _, report in rows)
    for _ in adviser.steps(latest):
        pass
    asking = [uav for uav in uavs if not adviser.held[uav].report.flies]
    before = adviser.state(asking)
    ground = node.ground
    chooses = torch.tensor([[uav in asking for uav in uavs]])
    after = node.simulation.decide(before, adviser.ask(asking), chooses)
    answers = []
    for i, uav in enumerate(uavs):
        here = int(before.goal[0, i])
        there = int(after.goal[0, i])
        answer: dict[str, Any] = {"ID": uav, "state": "in flight"}
        if uav in asking:
            answer["state"], (distance, heading) = (
                "hold" if here == there else "fly",
                ground.way(here, there),
            )
            answer |= dict(zip(ground.columns, ground.place(there), strict=True))
            answer |= {"distance": distance, "heading": None if here == there else heading}
        answers.append(answer | {"age": round(max(latest - adviser.held[uav].report.time, 0.0), 3)})
    return pd.DataFrame(
        answers, columns=["ID", "state", *ground.columns, "distance", "heading", "age"]
    )
