"""A step with the resets after it, in one function: the same bits as by TorchRL's own way."""

import pytest
import torch
from delayed_envs import DELAYS, choices, delayed, every_delay
from helpers import both_kinds, both_motions, everything, same
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, RewardSum, StepCounter

from damian.delays.config import DelayConfig, LinkConfig
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.envs.scenario import ScenarioConfig
from damian.keys import AGENTS, EPISODE_REWARD, GLOBAL_OBSERVATION, REWARD
from damian.settings import ClockConfig
from damian.transforms.reward import EpisodeTotals

STEPS = 20


def counted(scenario: ScenarioConfig) -> DelayedEnv:
    """An environment that counts, as for training; episodes end after 8 steps at the latest."""
    env = delayed(scenario)
    env.append_transform(EpisodeTotals())
    return env


def counted_by_torchrl(scenario: ScenarioConfig) -> DelayedEnv:
    env = delayed(scenario)
    env.append_transform(RewardSum([REWARD], [EPISODE_REWARD]))
    env.append_transform(StepCounter())
    return env


def steps_of(env: EnvBase, actions: list[Tensor], step=None) -> list[TensorDictBase]:
    """What each step returns: its TensorDict, and that with which the next one begins."""
    following, shown = env.reset(), []
    for t, action in enumerate(actions):
        if t == 3:  # from here on the episode of one world ends at another time than the others
            begins = torch.arange(env.batch_size[0]).view(-1, 1) == 1
            following = env.reset(following.set("_reset", begins))
        following = following.clone().set((AGENTS, "action"), action)
        following.set("policy_note", torch.ones(env.batch_size))  # as if a policy had written it
        following.set((AGENTS, "logits"), torch.zeros(*action.shape[:2], 5))
        after, following = (step or env.step_and_maybe_reset)(following)
        shown += [after.clone(), following.clone()]
    return shown


def outputs_of(step: TensorDictBase) -> TensorDictBase:
    """What the environment outputs; TorchRL sets what policies have written to 0 in some of the resets."""
    return step.exclude("policy_note", (AGENTS, "action"), (AGENTS, "logits"))


def check_equal_to_torchrls_way(scenario: ScenarioConfig) -> None:
    env, other = counted(scenario), counted(scenario)
    actions = choices(env, STEPS)
    ours = steps_of(env, actions)
    generic = steps_of(other, actions, lambda td: EnvBase._step_and_maybe_reset(other, td))
    foreign = steps_of(counted_by_torchrl(scenario), actions)
    assert any(td["next", "done"].any() and not td["next", "done"].all() for td in ours[::2])
    for one, second, third in zip(ours, generic, foreign, strict=True):
        assert set(one.keys(True, True)) == set(second.keys(True, True)) == set(third.keys(True, True))
        assert same(outputs_of(one), outputs_of(second))
        assert same(outputs_of(one), outputs_of(third))


@pytest.mark.sample(2)
@both_motions
@both_kinds
def test_without_delays(motion, kind):
    check_equal_to_torchrls_way(everything(motion, kind))


@pytest.mark.sample(2)
@every_delay
def test_with_delays(delays):
    check_equal_to_torchrls_way(everything("polynomial", **DELAYS[delays]))


def test_with_links_between_uavs():
    delay = DelayConfig(obs=2, loss=0.1)
    check_equal_to_torchrls_way(everything(delay=delay, links=LinkConfig(kind="matrix", delay=1)))


def test_with_merged_steps_the_totals_are_those_of_decisions():
    scenario = everything("polynomial", clock=ClockConfig(skip=True, skip_discount=0.9))
    envs = [make_env(scenario, 4, extras=()) for _ in range(2)]
    envs[0].append_transform(EpisodeTotals())
    envs[1].append_transform(RewardSum([REWARD], [EPISODE_REWARD]))
    envs[1].append_transform(StepCounter())
    actions = choices(envs[0], STEPS)
    ours, torchrls = (steps_of(env, actions) for env in envs)
    assert any(td["next", "duration"].max() > 1 for td in ours[::2])
    assert all(same(outputs_of(one), outputs_of(other)) for one, other in zip(ours, torchrls, strict=True))


@pytest.mark.parametrize("delay", [DelayConfig(), DelayConfig(obs=2, loss=0.1)])
def test_remembered_coverage_is_that_of_the_messages(delay):
    env = delayed(everything("polynomial", delay=delay))
    assert env.server.remembers_coverage
    for step in steps_of(env, choices(env, STEPS))[::2]:
        held = step["next", AGENTS].get("received", step["next", AGENTS, "message"])
        elapsed = torch.zeros(env.batch_size, dtype=torch.long)
        features = env.server.features(env.server.messages(held), elapsed)
        column = env.server.observation.critic.index("coverage")
        n_distances = env.uav_env.n_agents - 1  # one feature has a column for each other UAV
        column += (n_distances - 1) * ("agent_distances" in env.server.observation.critic[:column])
        assert torch.equal(step["next", GLOBAL_OBSERVATION][..., column], features["coverage"])


@pytest.mark.slow
@pytest.mark.parametrize("delays", ["paper", "everything"])
@both_motions
def test_compiled(delays, motion):
    scenario = everything(motion, **DELAYS[delays])
    env, compiled = counted(scenario), counted(scenario).compile()
    actions = choices(env, STEPS)
    for eager, other in zip(steps_of(env, actions), steps_of(compiled, actions), strict=True):
        assert set(eager.keys(True, True)) == set(other.keys(True, True))
        for key, value in eager.items(True, True):
            exact = not value.is_floating_point()
            assert torch.equal(value, other[key]) if exact else torch.allclose(value, other[key], atol=1e-6)
