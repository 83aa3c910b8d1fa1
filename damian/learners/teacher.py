"""Labels the steps of a batch with the actions of a teacher: the script or the planner."""

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from torch import Tensor

from damian import keys
from damian.baselines.planner import Planner
from damian.common import checks
from damian.envs.forward import ToldWorlds

if TYPE_CHECKING:
    from damian.envs.uav_env import UavEnv


class Teacher:
    """Tells which actions a teacher would choose, in states as the messages sent there tell them.

    Nothing is late for a teacher, so that it needs a simulator. It does not know where sources are.

    Args:
        worlds: environment of the training.
        name: ``script`` or ``planner``.
        horizon: steps that the planner looks ahead.
        compile: compile what the planner simulates.

    Raises:
        InputError: actions are continuous.
    """

    def __init__(
        self, worlds: "UavEnv", name: str, horizon: int = 4, compile: bool = False
    ) -> None:
        discrete = worlds.scenario.actions.kind == "discrete"
        checks.require(discrete, "learner.teacher", name, "needs discrete actions")
        self.server = worlds.server
        self.simulation = ToldWorlds(worlds.simulation)
        planner = Planner(worlds, self.simulation, horizon, samples=1, compile=compile)
        self.choose = planner.plan if name == "planner" else planner.choice

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase) -> Tensor:
        """The teacher's actions in the steps of a batch [B, T] with messages, [B, T, N]."""
        chosen = []
        for step in batch.unbind(1):  # the planner's copies of all steps would not fit in memory
            messages = self.server.messages(step[keys.MESSAGE])
            region = self.server.region_of(messages)
            elapsed = step[keys.STEP_COUNT].squeeze(-1)
            state = self.simulation.state_of(messages, region, elapsed)
            chosen.append(self.choose(state._replace(requests=messages.requests[:, 0])))
        return torch.stack(chosen, 1)
