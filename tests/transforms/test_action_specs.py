"""Ranges and defaults of actions, as they are read from action specs."""

import pytest
import torch
from delay_twin import ACTION
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiOneHot,
    OneHot,
    Unbounded,
)
from torchrl.envs import EnvBase, TransformedEnv

from damian import ActionDelay, ActionHistory

GROUP = (3, 2)
"""Worlds, and agents in each of them."""


class Plain(EnvBase):
    """Three worlds of two agents, whose actions, of any spec [3, 2, ...], have no effect."""

    def __init__(self, action):
        super().__init__(batch_size=torch.Size(GROUP[:1]))
        self.action_spec = self._agents(action=action)
        self.observation_spec = self._agents(observation=Unbounded((*GROUP, 4)))
        self.reward_spec = self._agents(reward=Unbounded((*GROUP, 1)))

    def _agents(self, **specs):
        return Composite(agents=Composite(**specs, shape=GROUP), shape=self.batch_size)

    def _reset(self, tensordict=None, **_):
        return self.observation_spec.zero()

    def _step(self, tensordict):
        return (
            self.observation_spec.zero()
            .update(self.full_reward_spec.zero())
            .update(self.full_done_spec.zero())
        )

    def _set_seed(self, seed):
        """The environment has no randomness."""


HISTORY = ("agents", "action_history")


def numbered(first):
    """Different whole numbers for each number of an action, [3, 2, 2]."""
    return first + torch.arange(12).view(*GROUP, 2)


RANGES = {
    "different numbers": (
        Bounded(-numbered(3).double(), numbered(5).double(), (*GROUP, 2), dtype=torch.float64),
        -numbered(3),
        numbered(5),
    ),
    "one possible value": (
        Bounded(
            torch.full((*GROUP, 2), 2.0), torch.tensor([2.0, 4.0]).expand(*GROUP, 2), (*GROUP, 2)
        ),
        torch.full((*GROUP, 2), 2.0),
        torch.tensor([2.0, 4.0]).expand(*GROUP, 2),
    ),
}


@pytest.mark.parametrize(("spec", "low", "high"), RANGES.values(), ids=RANGES)
def test_every_number_of_every_agent_is_scaled_by_its_own_bounds(spec, low, high):
    env = TransformedEnv(Plain(spec), ActionHistory(1, ACTION))
    for seed in range(5):
        torch.manual_seed(seed)
        action = (low + torch.rand(low.shape) * (high - low)).to(spec.dtype)
        found = env.step(env.reset().set(ACTION, action))["next", *HISTORY]
        assert found.shape == (*GROUP, 2)
        for at in torch.cartesian_prod(*map(torch.arange, (*GROUP, 2))).tolist():
            a, lowest, highest = (float(values[tuple(at)]) for values in (action, low, high))
            expected = (a - lowest) / (highest - lowest) if highest > lowest else 0.0
            assert found[tuple(at)].item() == pytest.approx(expected, abs=1e-6)


# Defaults.

LEGAL = {
    "a number for each agent": (Categorical(5, GROUP), [3, 4], torch.tensor([3, 4]).expand(GROUP)),
    "none": (Bounded(2, 7, GROUP, dtype=torch.int64), None, torch.full(GROUP, 2)),
    "index": (OneHot(3, (*GROUP, 3)), 2, torch.tensor([0, 0, 1]).expand(*GROUP, 3)),
    "indices": (
        MultiOneHot([2, 3], (*GROUP, 5)),
        [1, 2],
        torch.tensor([0, 1, 0, 0, 1]).expand(*GROUP, 5),
    ),
    "flags": (Binary(3, (*GROUP, 3)), [0, 1, 1], torch.tensor([0, 1, 1]).expand(*GROUP, 3)),
}


@pytest.mark.parametrize(("spec", "default", "expected"), LEGAL.values(), ids=LEGAL)
def test_a_legal_default_is_executed_first(spec, default, expected):
    delay = ActionDelay(2, ACTION, default=default)
    env = TransformedEnv(Plain(spec), delay)
    td = env.reset().set(ACTION, torch.zeros(expected.shape, dtype=spec.dtype))
    executed = delay.inv(td)[ACTION]
    assert executed.equal(expected.to(spec.dtype))
    history = TransformedEnv(Plain(spec), ActionHistory(2, ACTION, default=default)).reset()[
        HISTORY
    ]
    assert history.isfinite().all()
