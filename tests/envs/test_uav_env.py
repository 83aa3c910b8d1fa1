"""``UavEnv`` as a TorchRL environment: specs, skipped steps and seeds."""

import pytest
import torch
from helpers import (
    KINDS,
    MOTIONS,
    REGIONS,
    all_same,
    both_kinds,
    both_motions,
    everything,
    play,
    random_actions,
    same,
)
from torchrl.envs.utils import check_env_specs

from damian import DelayConfig, ScenarioConfig, UavEnv, make_env
from damian.keys import ACTION
from damian.server.config import BUILT_IN
from damian.world.config import ActionConfig

# Specs and TorchRL's rules.


@both_motions
def test_a_world_that_skips_steps_goes_on_as_if_they_had_not_been(motion):
    delay = DelayConfig(
        obs={"law": "burst"},
        act={
            "law": "uniform",
            "low": 0,
            "high": 2,
        },
        rew=1,
        history=2,
    )
    scenario = everything(motion, delay=delay)
    skipping, steady = (make_env(scenario, 2, seed=4) for _ in range(2))
    td = skipping.reset()
    other = steady.reset()
    for _ in range(6):
        action = random_actions(steady.base_env)
        after = steady.step(other.clone().set(ACTION, action))["next"]
        for world in (0, 1):  # first the one, then the other
            mask = torch.arange(2) == world
            stepped = skipping.step(td.clone().set(ACTION, action).set("_step", mask))["next"]
            assert same(stepped[world], after[world])
            assert same(
                stepped[1 - world].select(*td.keys(True, True), strict=False), td[1 - world]
            )
            td = stepped.select(*td.keys(True, True), strict=False)
        other = after.select(*other.keys(True, True), strict=False)


@pytest.mark.sample(6)
@pytest.mark.parametrize("region", REGIONS)
@both_kinds
@both_motions
@pytest.mark.parametrize("scenario", KINDS)
def test_the_specs_of_every_kind_of_scenario_are_right(scenario, motion, kind, region):
    config = ScenarioConfig(
        **KINDS[scenario],
        agents=2,
        region=REGIONS[region],
        motion=MOTIONS[motion],
        actions=ActionConfig(
            kind=kind,
            distances=[0.0, 60.0],
            headings=[0.0, 90.0, 180.0, 270.0],
        ),
    )
    check_env_specs(UavEnv(config, num_worlds=2), seed=0, break_when_any_done="both")


@both_kinds
@both_motions
def test_all_observations_lie_between_0_and_1_and_rewards_are_the_sum_of_their_terms(motion, kind):
    env = UavEnv(everything(motion, kind), num_worlds=16)
    td = env.rollout(40, lambda td: td.set(ACTION, random_actions(env)), break_when_any_done=False)
    for name in ("observation", "global_observation"):
        observation = td["next", "agents", name]
        ways = 4 * (3 * env.server.observation.timeline + 3)  # of the timeline, which come last
        assert (observation.abs() <= 1).all()
        assert (observation[..., :-ways] >= 0).all()
    terms = td["next", "agents", "reward_terms"]
    assert set(terms.keys()) == {*BUILT_IN} - {"served"}
    rest = td["next", "agents", "reward"].squeeze(-1) - sum(terms.values())
    final = 1.0 * td["next", "success"] - 0.25 * (td["next", "done"] & ~td["next", "success"])
    torch.testing.assert_close(
        rest,
        final.expand_as(rest),
        atol=1e-5,
        rtol=0,
    )
    assert td["next", "done"].any()


# Worlds and seeds.


def test_set_seed_repeats_a_rollout_and_worlds_and_episodes_differ():
    env = UavEnv(everything(), num_worlds=8)
    actions = [random_actions(env) for _ in range(12)]

    def rollout(seed):
        env.set_seed(seed)
        return play(env, actions)

    first = rollout(7)
    assert all_same(first, rollout(7))
    assert not all_same(first, rollout(8))
    starts = {tuple(world) for world in first[0]["state"].tolist()}
    assert len(starts) > 3
    assert len({int(env.reset()[0]["state"].sum() * 100) for _ in range(20)}) > 3
