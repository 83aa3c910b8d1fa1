"""Your own features, of any width and range, read sensors wherever features are computed."""

import pytest
import torch
from helpers import both_kinds, both_motions, everything, play, random_actions
from sensor_cases import GLOBAL, LOCAL, SENSORS
from torchrl.envs.utils import check_env_specs

from damian import ClockConfig, DelayConfig, make_env
from damian.server.config import EpisodeConfig, ObservationConfig, RewardConfig


def sensing(motion="instant", own=False, **changed):
    """Episodes without end, and readings in the actor's and the critic's observation and in the
    reward."""
    observation = ObservationConfig(
        ["spotted", *LOCAL], [*GLOBAL, "source_time"], ctde=True, own=own
    )
    reward = RewardConfig(spotted=0.0, custom=[{"term": "sensor_cases:calm"}])
    sections = {"observation": observation, "reward": reward, "sensors": SENSORS}
    return everything(motion, episode=EpisodeConfig(max_steps=None), **(sections | changed))


def fly(scenario, n_steps=20):
    """The first output, and those after each of the same random actions."""
    env = make_env(scenario, 4, seed=1, extras=["message"])
    outputs = play(env, [random_actions(env.uav_env) for _ in range(n_steps)])
    return [outputs[0], *outputs[1::2]]


@both_motions
def test_a_reward_term_reads_features_of_any_width_and_range(motion):
    for output in fly(sensing(motion))[1:]:
        felt = output["agents", "observation"][..., 1:3]
        widest = output["agents", "global_observation"][..., 0]
        assert output["agents", "reward"].squeeze(-1).equal(felt.sum(-1) + widest)


# Specs.


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {
            "delay": DelayConfig(obs=2, history=3),
            "clock": ClockConfig(agents="2s", server="2s"),
        },
        {"delay": DelayConfig(obs=2, history=1), "own": True},
    ],
)
@both_kinds
def test_the_specs_have_the_range_of_every_feature(kind, changed):
    scenario = sensing(**changed)
    scenario.actions.kind = kind
    env = make_env(scenario, 2, extras=["message", "privileged"])
    check_env_specs(env, seed=0)
    history = 2 * scenario.delay.history
    critic = [0] * 6 + [-1, -1], [1e4] * 4 + [1] * 4
    expected = {
        "observation": ([0, -1, -1] + [0] * history, [1] * (3 + history)),
        "global_observation": critic,
        "privileged_observation": (critic[0] + [-1, -1], critic[1] + [1, 1]),
    }
    for name, (low, high) in expected.items():
        spec = env.observation_spec["agents", name]
        assert spec.low.equal(torch.tensor(low).expand(spec.shape).float()), name
        assert spec.high.equal(torch.tensor(high).expand(spec.shape).float()), name
