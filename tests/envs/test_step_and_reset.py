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
from damian.envs.scenario import ScenarioConfig
from damian.keys import AGENTS, EPISODE_REWARD, REWARD
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


@pytest.mark.sample(3)
@every_delay
def test_with_delays(delays):
    check_equal_to_torchrls_way(everything("polynomial", **DELAYS[delays]))


def test_with_links_between_uavs():
    delay = DelayConfig(obs=2, loss=0.1)
    check_equal_to_torchrls_way(everything(delay=delay, links=LinkConfig(kind="matrix", delay=1)))
