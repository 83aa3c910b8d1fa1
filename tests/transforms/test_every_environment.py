"""Delay 0 changes nothing, and outputs match the specs, on every kind of environment."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import pytest
import torch
from delay_twin import Counting
from helpers import same
from tensordict import TensorDictBase
from torchrl.envs import Compose, EnvBase, GymEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs
from transform_cases import ACTION, OBSERVATION, PAPER, REWARD, WORLDS, trace

from damian.delays.laws import Burst, Geometric, Uniform
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    CumulativeReward,
    ObservationDelay,
    RewardDelay,
    SampleAndHold,
    StatefulTransform,
)

# Properties that the transforms have on every kind of environment.


class Kind(NamedTuple):
    """An environment, and the keys of its entries."""

    make: Callable[[], EnvBase]
    observation: Any = OBSERVATION
    action: Any = ACTION
    reward: Any = REWARD
    steps: int = 30
    """Number of steps in which an episode ends."""


def vmas(**options: Any) -> EnvBase:
    """A multi-agent environment of VMAS."""
    pytest.importorskip("vmas")
    from torchrl.envs.libs.vmas import VmasEnv  # noqa: PLC0415

    return VmasEnv("balance", num_envs=2, seed=0, max_steps=8, n_agents=2, **options)


def two(name: str, **options: Any) -> EnvBase:
    """Two Gymnasium environments side by side, whose episodes end at different steps."""
    return SerialEnv(2, lambda: GymEnv(name, **options))


ROOT = ("observation", "action", "reward")
KINDS = {
    "CartPole": Kind(lambda: two("CartPole-v1"), *ROOT),
    "CartPole, numbered": Kind(lambda: two("CartPole-v1", categorical_action_encoding=True), *ROOT),
    "Pendulum": Kind(lambda: two("Pendulum-v1"), *ROOT),
    "CartPole, alone": Kind(lambda: GymEnv("CartPole-v1"), *ROOT),
    "CartPole, alone, numbered": Kind(lambda: GymEnv("CartPole-v1", categorical_action_encoding=True), *ROOT),
    "Pendulum, alone": Kind(lambda: GymEnv("Pendulum-v1"), *ROOT),
    "counting": Kind(lambda: Counting(WORLDS)),
    "counting, continuous": Kind(lambda: Counting(WORLDS, continuous=True)),
    "VMAS": Kind(lambda: vmas(continuous_actions=True), steps=10),
    "VMAS, discrete": Kind(lambda: vmas(continuous_actions=False), steps=10),
}
kinds = pytest.mark.parametrize("kind", KINDS)


def rollout_of(env: EnvBase, steps: int) -> list[TensorDictBase]:
    """Outputs of every step and every reset under random actions, which are the same at each call."""
    torch.manual_seed(0)
    env.set_seed(0)
    td, outputs = env.reset(), []
    for _ in range(steps):
        stepped, td = env.step_and_maybe_reset(env.rand_action(td))
        outputs += [stepped.clone(), td.clone()]
    return outputs


@cache
def undelayed_rollout_of(kind: str) -> list[TensorDictBase]:
    """The rollout of an environment without transforms."""
    return rollout_of(KINDS[kind].make(), KINDS[kind].steps)


TRANSFORMS: dict[str, Callable[[Kind, Any], StatefulTransform]] = {
    "observation": lambda kind, law: ObservationDelay(law, [kind.observation], seed=1),
    "observation by arrival": lambda kind, law: ObservationDelay(
        law, [kind.observation], order="arrival", seed=1, fresh_key="fresh", delay_key="delay"
    ),
    "action": lambda kind, law: ActionDelay(law, kind.action, seed=1),
    "reward": lambda kind, law: RewardDelay(law, kind.reward, seed=1),
}
ZERO_DELAYS = {
    "steps": lambda _: 0,
    "a time": lambda _: "0s",
    "uniform": lambda _: Uniform(0, 0, 0.5),
    "never": lambda _: Uniform("3s", "7s", 0.0),
    "geometric": lambda _: Geometric(0, 3),
    "burst": lambda _: Burst(good=0, bad=0, bad_loss=0.0),
    "trace": lambda folder: trace(folder, 0, 0, 0),
}


def check_unchanged(outputs: list[TensorDictBase], undelayed: list[TensorDictBase]) -> None:
    """Check that the outputs contain those without delay, bit for bit and with the same dtypes."""
    for one, other in zip(outputs, undelayed, strict=True):
        assert same(one.select(*other.keys(True, True)), other)
        assert all(one[key].dtype == value.dtype for key, value in other.items(True, True))


ZERO_DELAY_CASES = [
    (kind, law) for kind in KINDS for law in ZERO_DELAYS if kind == "counting" or law in ("steps", "burst")
]
"""Every law on one environment, and two laws on the others."""


@pytest.mark.sample(6)
@pytest.mark.parametrize(("kind", "zero_delay"), ZERO_DELAY_CASES)
@pytest.mark.parametrize("transform", TRANSFORMS)
def test_with_delay_0_nothing_changes(kind, transform, zero_delay, tmp_path):
    case = KINDS[kind]
    delay = TRANSFORMS[transform](case, ZERO_DELAYS[zero_delay](tmp_path))
    check_unchanged(rollout_of(TransformedEnv(case.make(), delay), case.steps), undelayed_rollout_of(kind))


@pytest.mark.sample(3)
@kinds
def test_a_clock_of_period_1_a_sum_of_one_reward_and_a_history_change_nothing(kind):
    case = KINDS[kind]
    for transform in (
        SampleAndHold(1, [case.observation], [case.action]),
        CumulativeReward(1, 0.5, case.reward),
        ActionHistory(2, case.action),
    ):
        check_unchanged(
            rollout_of(TransformedEnv(case.make(), transform), case.steps), undelayed_rollout_of(kind)
        )


@pytest.mark.sample(2)
@kinds
@pytest.mark.parametrize("law", [3, Burst(good=PAPER, bad_loss=0.0)], ids=["constant", "burst"])
def test_the_outputs_of_delayed_environments_match_the_specs(kind, law):
    for make in TRANSFORMS.values():
        env = TransformedEnv(KINDS[kind].make(), make(KINDS[kind], law))
        check_env_specs(env, seed=0, break_when_any_done="both")


@kinds
def test_the_outputs_with_clocks_sums_and_histories_match_the_specs(kind):
    case = KINDS[kind]
    for transform in (
        SampleAndHold(3, [case.observation], [case.action]),
        CumulativeReward(4, 0.9, case.reward),
        ActionHistory(2, case.action),
        ActionHistory(2, case.action, append_to=case.observation),
    ):
        check_env_specs(TransformedEnv(case.make(), transform), seed=0, break_when_any_done="both")


def test_appending_actions_keeps_the_bounds_of_an_observation_and_adds_those_of_the_actions():
    env = TransformedEnv(GymEnv("Pendulum-v1"), ActionHistory(2, append_to="observation"))
    spec = env.observation_spec["observation"]
    assert spec.low.tolist() == [-1, -1, -8, 0, 0]
    assert spec.high.tolist() == [1, 1, 8, 1, 1]


@kinds
def test_the_outputs_with_all_transforms_together_match_the_specs(kind):
    case = KINDS[kind]
    chain = [
        ActionDelay(2, case.action),
        ObservationDelay(PAPER, [case.observation], loss=0.1, fresh_key="fresh", delay_key="delay"),
        RewardDelay(1, case.reward),
        CumulativeReward(3, 0.9, case.reward),
        SampleAndHold(2, [case.observation], age_key="age"),
        ActionHistory(2, case.action, append_to=case.observation),
    ]
    check_env_specs(TransformedEnv(case.make(), Compose(*chain)), seed=0, break_when_any_done="both")
