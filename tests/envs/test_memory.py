"""What would not fit into memory is refused in one line, before anything of its size is allocated."""

from typing import Any

import pytest
from helpers import square
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.envs import GymEnv, TransformedEnv

from damian.common import checks
from damian.common.errors import InputError
from damian.delays.config import DelayConfig, LinkConfig
from damian.envs.pipeline import make_env
from damian.envs.uav_env import UavEnv
from damian.transforms import ActionDelay, ActionHistory, ObservationDelay, RewardDelay
from damian.transforms.base import StatefulTransform

LARGE = {
    "delay.obs": {"delay": DelayConfig(obs=10_000)},
    "delay.act": {"delay": DelayConfig(act={"law": "uniform", "high": 10_000})},
    "delay.rew": {"delay": DelayConfig(rew="10000s")},
    "delay.reward_window": {"delay": DelayConfig(reward_window=10_000)},
    "delay.history": {"delay": DelayConfig(history=1000)},
    "updown": {"links": LinkConfig("updown", delay=10_000)},
    "matrix": {"links": LinkConfig("matrix", delay=10_000)},
}
"""Scenario sections that remember much, by the setting that an error names, or by the kind of links."""


class LargestTensor(TorchDispatchMode):
    """Measures the largest tensor that is allocated [bytes]."""

    bytes = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        if isinstance(out, Tensor):
            self.bytes = max(self.bytes, out.untyped_storage().nbytes())
        return out


@pytest.mark.parametrize("name", LARGE)
def test_a_delay_that_does_not_fit_is_refused_by_its_key_and_allocates_nothing(name, monkeypatch):
    monkeypatch.setattr(checks, "MEMORY_BYTES", 1_000_000)
    key = "links.delay" if name in ("updown", "matrix") else name
    with LargestTensor() as largest, pytest.raises(InputError) as refused:
        make_env(square(**LARGE[name]), 64)
    message = str(refused.value)
    assert message.startswith(f"{key}: ")
    assert "GB of memory, more than 0.001 GB: take a smaller one, or fewer worlds" in message
    assert "\n" not in message
    assert largest.bytes < 1_000_000


def test_a_message_delay_of_ten_thousand_steps_in_8192_worlds_is_refused():
    message = r"delay.obs: 10000 needs 16\.\d GB of memory, more than 4 GB: .* than 8192 x 3$"
    with pytest.raises(InputError, match=message):
        make_env(square(delay=DelayConfig(obs=10_000)), 8192)


@pytest.mark.parametrize("name", LARGE)
def test_the_size_of_a_memory_is_known_before_it_is_allocated(name):
    env = make_env(square(**LARGE[name]), 2, extras=["message"])
    first = env.reset()
    for transform in env.transform:
        assert isinstance(transform, StatefulTransform)
        found = sum(buffer.nbytes for buffer in transform.memory.values())
        expected = transform.memory_bytes(first, transform.rows.numel())
        if not isinstance(transform, ActionHistory) and expected:
            assert found == pytest.approx(expected, rel=0.02)
        assert expected or found < 10_000


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: ObservationDelay(5000), "ObservationDelay: delay: 5000 needs"),
        (lambda: ActionDelay(5000), "ActionDelay: delay: 5000 needs"),
        (lambda: RewardDelay(5000), "RewardDelay: delay: 5000 needs"),
        (lambda: ActionHistory(5000), "ActionHistory: steps: 5000 needs"),
    ],
)
def test_a_transform_of_another_environment_names_itself(make: Any, key: str, monkeypatch):
    monkeypatch.setattr(checks, "MEMORY_BYTES", 50_000)
    with pytest.raises(InputError, match=key):
        TransformedEnv(GymEnv("Pendulum-v1"), make()).reset()


def test_worlds_whose_state_does_not_fit_are_refused(monkeypatch):
    monkeypatch.setattr(checks, "MEMORY_BYTES", 1_000_000)
    message = r"num_worlds: 20000 needs 0\.0 GB of memory, more than 0\.001 GB: take fewer of these worlds"
    with LargestTensor() as largest, pytest.raises(InputError, match=message):
        UavEnv(square(), 20_000)
    assert largest.bytes < 1_000_000
