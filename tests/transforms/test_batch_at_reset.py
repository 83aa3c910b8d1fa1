"""Environments whose batch is chosen at a reset behave as that many single ones."""

import pytest
import torch
from torchrl.envs import Compose, PendulumEnv, TransformedEnv

from damian.transforms import ActionDelay, ActionHistory, CumulativeReward, RewardDelay

LATE = {"law": "uniform", "low": 0, "high": 3}
TRANSFORMS = {
    "ActionDelay": lambda: [ActionDelay(LATE, default=1.5)],
    "ActionHistory": lambda: [ActionHistory(3, default=-1.0)],
    "RewardDelay": lambda: [RewardDelay(LATE)],
    "CumulativeReward": lambda: [CumulativeReward(3)],
    "all": lambda: [ActionDelay(LATE), RewardDelay(LATE), CumulativeReward(2), ActionHistory(2)],
}
STATES = torch.rand(5, 2, generator=torch.Generator().manual_seed(0))
ACTIONS = torch.rand(12, 5, 1, generator=torch.Generator().manual_seed(1)) * 4 - 2


def flown(transforms, worlds):
    """Outputs of 12 steps of pendulums with these numbers, [T, *batch]; one number gives no batch."""
    single = isinstance(worlds, int)
    names = torch.tensor([worlds] if single else worlds)
    for transform in transforms:
        transform.seed_worlds(names)
    env = TransformedEnv(PendulumEnv(), Compose(*transforms))
    start = env.gen_params(batch_size=[] if single else [len(names)])
    angle, speed = STATES[worlds].unbind(-1)
    td = env.reset(start.update({"th": angle, "thdot": speed}), set_state=True)
    outputs = []
    for action in ACTIONS[:, worlds]:
        stepped = env.step(td.set("action", action))
        outputs.append(stepped["next"].clone())
        td = env.step_mdp(stepped)
    return torch.stack(outputs)


@pytest.mark.parametrize("make", TRANSFORMS.values(), ids=TRANSFORMS)
@pytest.mark.parametrize("worlds", [[0, 1, 2, 3, 4], [3]])
def test_a_batch_does_the_same_as_single_environments(make, worlds):
    together = flown(make(), worlds)
    assert together.batch_size == (12, len(worlds))
    for i, world in enumerate(worlds):
        alone = flown(make(), world)
        for key, value in alone.items(True, True):
            assert together[:, i][key].equal(value), key
