# Copyright (c) Meta Platforms, Inc. and affiliates.
#
# This source code is licensed under the MIT license found in the
# LICENSE file in the root directory of this source tree.
"""Observations and actions that are late, and timelines of what is known."""

from __future__ import annotations

import pytest
import torch
from _transforms_common import TransformBase
from tensordict import TensorDict
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import (
    ActionDelay,
    Compose,
    ObservationDelay,
    ObservationTimeline,
    SerialEnv,
    TransformedEnv,
)
from torchrl.envs.transforms.delays import set_seed
from torchrl.envs.utils import check_env_specs
from torchrl.testing.mocking_classes import (
    ContinuousActionVecMockEnv,
    CountingEnv,
    NestedCountingEnv,
)


def onward(td):
    """A policy with which ``CountingEnv`` counts its steps."""
    return td.set("action", torch.ones(1, dtype=torch.int8))


class Contract(TransformBase):
    """What TorchRL asks of every transform; ``make`` makes one."""

    def make(self):
        raise NotImplementedError

    def late_env(self):
        return TransformedEnv(ContinuousActionVecMockEnv(), self.make())

    def check(self, env):
        try:
            check_env_specs(env)
        finally:
            env.close(raise_if_closed=False)

    def test_single_trans_env_check(self):
        self.check(self.late_env())

    def test_serial_trans_env_check(self):
        self.check(SerialEnv(2, self.late_env))

    def test_parallel_trans_env_check(self, maybe_fork_ParallelEnv):
        self.check(maybe_fork_ParallelEnv(2, self.late_env))

    def test_trans_serial_env_check(self):
        self.check(TransformedEnv(SerialEnv(2, ContinuousActionVecMockEnv), self.make()))

    def test_trans_parallel_env_check(self, maybe_fork_ParallelEnv):
        self.check(
            TransformedEnv(maybe_fork_ParallelEnv(2, ContinuousActionVecMockEnv), self.make())
        )

    def refused(self):
        return pytest.raises(RuntimeError, match="works only in an environment")

    def test_transform_no_env(self):
        with self.refused():
            self.make()(TensorDict(observation=torch.zeros(3)))

    def test_transform_compose(self):
        with self.refused():
            Compose(self.make())(TensorDict(observation=torch.zeros(3)))

    def test_transform_model(self):
        with self.refused():
            nn.Sequential(self.make(), nn.Identity())(TensorDict(observation=torch.zeros(3)))

    def test_transform_rb(self):
        buffer = ReplayBuffer(storage=LazyTensorStorage(4), batch_size=2)
        buffer.extend(TensorDict(observation=torch.zeros(4, 3), batch_size=[4]))
        buffer.append_transform(self.make())
        with self.refused():
            buffer.sample()

    def test_transform_inverse(self):
        pytest.skip("An observation has no inverse")


class TestObservationDelay(Contract):
    def make(self):
        return ObservationDelay((1, 3), "observation", delay_key="delay", loss=0.1)

    def test_transform_env(self):
        env = TransformedEnv(CountingEnv(max_steps=10), ObservationDelay(3))
        assert env.reset()["observation"].item() == 0
        steps = env.rollout(8, onward)["next"]
        assert steps["observation"].flatten().tolist() == [0, 0, 0, 1, 2, 3, 4, 5]
        assert steps["age"].flatten().tolist() == [1, 2, 3, 3, 3, 3, 3, 3]

    def test_a_delay_belongs_to_a_message(self):
        env = TransformedEnv(
            CountingEnv(max_steps=200), ObservationDelay((0, 4), delay_key="delay")
        )
        set_seed(env, 0)
        steps, newest = env.rollout(100, onward)["next"], [0]
        arrival = [t + 1 + d for t, d in enumerate(steps["delay"].flatten().tolist())]
        for t in range(1, 101):
            newest.append(
                max([newest[-1], *(i + 1 for i, at in enumerate(arrival[:t]) if at == t)])
            )
        assert steps["observation"].flatten().tolist() == newest[1:]

    def test_no_delay_is_the_identity(self):
        torch.manual_seed(0)
        plain = ContinuousActionVecMockEnv(seed=0).rollout(5)
        torch.manual_seed(0)
        late = TransformedEnv(ContinuousActionVecMockEnv(seed=0), ObservationDelay(0)).rollout(5)
        assert (late.select(*plain.keys(True, True)) == plain).all()

    def test_agents_have_delays_of_their_own(self):
        key = ("data", "states")
        env = TransformedEnv(
            NestedCountingEnv(nested_dim=50), ObservationDelay((0, 5), key, delay_key="delay")
        )
        check_env_specs(env)
        assert env.rollout(4)["next", "data", "delay"].unique().numel() > 3


class TestActionDelay(Contract):
    def make(self):
        return ActionDelay((1, 3), loss=0.1)

    def test_transform_env(self):
        env = TransformedEnv(CountingEnv(max_steps=20), ActionDelay(2))
        steps = env.rollout(6, onward)
        assert steps["next", "observation"].flatten().tolist() == [0, 0, 1, 2, 3, 4]
        assert steps["action"].all()  # as it was chosen

    def test_transform_inverse(self):
        with self.refused():
            self.make().inv(TensorDict(action=torch.zeros(3)))


class TestObservationTimeline(Contract):
    def make(self):
        late = ObservationDelay((1, 3), "observation", "received", delay_key="delay", loss=0.1)
        return Compose(late, ObservationTimeline(5, "observation", delay_key="delay"))

    def test_transform_env(self):
        late = ObservationDelay((0, 3), "observation", "received", delay_key="delay")
        line = ObservationTimeline(4, "observation", delay_key="delay")
        env = TransformedEnv(CountingEnv(max_steps=100), Compose(late, line))
        set_seed(env, 0)
        first = env.reset()["timeline"]
        assert first.tolist() == [[0, 1], [0, 0], [0, 0], [0, 0]]
        steps = env.rollout(50, onward)["next"]
        delays = [0, *steps["delay"].flatten().tolist()]
        for t, slots in enumerate(steps["timeline"].tolist(), 1):
            for k, (value, known) in enumerate(slots):
                there = k <= t and delays[t - k] <= k
                assert (value, known) == ((t - k, 1) if there else (0, 0))


if __name__ == "__main__":
    pytest.main([__file__, "--capture", "no", "--exitfirst"])
