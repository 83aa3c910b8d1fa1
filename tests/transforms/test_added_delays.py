"""Delays of actions and of observations add up."""

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from transform_cases import ACTION, N_AGENTS, OBSERVATION, REWARD, WORLDS, delayed

from damian.transforms import ActionDelay, ObservationDelay


@pytest.mark.parametrize(("i", "j"), [(0, 0), (0, 3), (3, 0), (1, 2), (3, 3)])
def test_delays_of_observations_and_actions_add_up(i, j):
    """Delays i and j have the same effect as an observation delay i + j (Katsikopoulos, Engelbrecht 2003).

    With both delays, the agent makes the same decisions, but j steps earlier.
    """

    def decide(td: TensorDictBase) -> Tensor:
        return ((td[OBSERVATION] * torch.arange(1.0, 8)).sum(-1) % 7).long()

    def run(env: EnvBase, default_steps: int) -> tuple[Tensor, Tensor, Tensor]:
        td, observed, executed, rewards = env.reset(), [], [], []
        for t in range(20):
            action = torch.zeros(len(WORLDS), N_AGENTS, dtype=torch.long) if t < default_steps else decide(td)
            observed.append(td[OBSERVATION])
            stepped, td = env.step_and_maybe_reset(td.set(ACTION, action))
            executed.append(env.base_env.executed)
            rewards.append(stepped["next", *REWARD])
        return torch.stack(observed), torch.stack(executed), torch.stack(rewards)

    both = run(delayed(ActionDelay(j, ACTION), ObservationDelay(i, [OBSERVATION]), ends=0.0), 0)
    summed = run(delayed(ObservationDelay(i + j, [OBSERVATION]), ends=0.0), j)
    assert both[0][: 20 - j].equal(summed[0][j:])
    assert both[1].equal(summed[1])
    assert both[2].equal(summed[2])
    assert len(both[1].unique()) > 3
