"""``DelayedEnv``: what holds in a scenario with any delays, losses and clocks, eager and
compiled."""

from dataclasses import replace
from itertools import product

import pytest
import torch
from delayed_envs import DELAYS, after_steps, choices, delayed, every_delay
from helpers import (
    FLYING,
    KEEPS_GOING,
    all_same,
    both_kinds,
    both_motions,
    everything,
    play,
    square,
)
from torchrl.envs import RewardSum, StepCounter, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from damian import (
    compose_scenario,
)
from damian.delays.config import DelayConfig, LinkConfig
from damian.envs.nodes import EpisodeTotals
from damian.envs.pipeline import make_env, make_transforms
from damian.envs.uav_env import EXTRAS, UavEnv
from damian.keys import (
    ACTION,
    AGE,
    EPISODE_REWARD,
    GLOBAL_OBSERVATION,
    MESSAGE,
    RECEIVED,
    REWARD,
)
from damian.world.config import ActionConfig, FailureConfig

# Without delays.


def check_equals_undelayed(env, scenario, n_steps=25):
    """Everything that the environment without transforms outputs is output, bit for bit."""
    undelayed = UavEnv(scenario, env.batch_size[0])
    expected = play(undelayed, choices(undelayed, n_steps))
    outputs = play(env, choices(undelayed, n_steps))
    assert all_same(
        [td.select(*expected[1].keys(True, True), strict=False) for td in outputs], expected
    )
    assert sum(td["done"].sum() for td in expected) > 0


def test_without_any_delay_there_are_no_transforms():
    nothing = DelayConfig(
        obs="0s",
        act={
            "law": "uniform",
            "high": "7s",
            "low": "3s",
            "probability": 0.0,
        },
    )
    env = make_env(everything(delay=nothing), 4, extras=EXTRAS)
    assert not [*env.transform.transforms]
    check_equals_undelayed(env, everything())


# Specs and TorchRL's rules.


@pytest.mark.sample(3)
@every_delay
@both_kinds
@both_motions
def test_the_specs_are_right_with_every_delay(delays, motion, kind):
    env = delayed(everything(motion, kind, **DELAYS[delays]), 2)
    check_env_specs(env, seed=0, break_when_any_done="both")


# Causality: nothing has an effect before it arrives.


class FalsifyMessage(Transform):
    """Changes the position in the message that one UAV sends in one step, for all later
    transforms."""

    def __init__(self, world, agent, step):
        super().__init__()
        self.sender = (world, agent)
        self.step_to_change = step
        self.steps = 0

    def _step(self, tensordict, next_tensordict):
        self.steps += 1
        if self.steps == self.step_to_change:
            message = next_tensordict[MESSAGE].clone()
            message[self.sender] = message[self.sender] - torch.eye(message.shape[-1])[1] * 7
            next_tensordict.set(MESSAGE, message)
        return next_tensordict

    def _reset(self, tensordict, tensordict_reset):
        return tensordict_reset


@pytest.mark.sample(4)
@pytest.mark.parametrize("order", ["generation", "arrival"])
@pytest.mark.parametrize(
    "obs",
    [
        4,
        {
            "law": "geometric",
            "mean": 3,
        },
    ],
)
def test_a_message_has_no_effect_before_it_arrives(obs, order):
    scenario = everything(episode=KEEPS_GOING, delay=DelayConfig(obs=obs, order=order))
    original = play(env := delayed(scenario), choices(env, 20))
    n_held = 0
    for world, agent, sent in ((0, 0, 3), (1, 2, 8), (3, 1, 11)):
        env = delayed(scenario)
        env.insert_transform(0, FalsifyMessage(world, agent, sent))
        falsified = play(env, choices(env, 20))
        delay = int(after_steps(original, ("agents", "delay"))[sent - 1, world, agent])
        arrival = 2 * (sent + delay) - 1
        received = (
            [td.exclude(MESSAGE) for td in original],
            [td.exclude(MESSAGE) for td in falsified],
        )
        assert all_same(received[0][:arrival], received[1][:arrival])
        others = torch.arange(4) != world
        assert all_same([td[others] for td in original], [td[others] for td in falsified])
        at_arrival = original[arrival], falsified[arrival]
        if at_arrival[0][AGE][world, agent] == delay:
            n_held += 1
            assert not at_arrival[0][RECEIVED][world, agent].equal(
                at_arrival[1][RECEIVED][world, agent]
            )
            one, other = (td[GLOBAL_OBSERVATION][world] for td in at_arrival)
            assert not one.equal(other)
    assert n_held >= 1


# Batches of worlds.


@pytest.mark.sample(6)
@every_delay
@both_motions
def test_worlds_stepped_together_equal_worlds_stepped_alone(delays, motion):
    scenario = everything(motion, **DELAYS[delays])
    seeds = torch.tensor([11, 5])
    env = delayed(scenario, 2)
    env.seed_worlds(seeds)
    actions = choices(env, 15)
    together = play(env, actions)
    for w in range(2):
        alone = delayed(scenario, 1)
        alone.seed_worlds(seeds[w : w + 1])
        outputs = play(alone, [action[w : w + 1] for action in actions])
        rounding = (
            1e-6 if delays == "belief" else 0.0
        )  # some processors multiply one row in another order
        assert all_same([td[w : w + 1] for td in together], outputs, rounding)


@pytest.mark.sample(6)
@every_delay
@both_motions
def test_a_reset_of_some_worlds_changes_only_their_rows(delays, motion):
    scenario = everything(motion, **DELAYS[delays] | {"episode": KEEPS_GOING})

    def rollout(mask):
        env = delayed(scenario)
        outputs = []
        td = env.reset()
        for t, action in enumerate(choices(env, 12)):
            stepped, td = env.step_and_maybe_reset(td.set(ACTION, action))
            td = td.exclude(ACTION)
            if t in (2, 4, 8) and any(mask):
                td = env.reset(td.set("_reset", torch.tensor(mask).unsqueeze(-1))).exclude("_reset")
            outputs += [stepped["next"].clone(), td.clone()]
        return outputs

    some = rollout([True, False, False, True])
    every = rollout([True] * 4)
    none = rollout([False] * 4)
    for worlds, expected in (([1, 2], none), ([0, 3], every)):
        for w in worlds:
            assert all_same([td[w] for td in some], [td[w] for td in expected])
    assert not all_same([td[0] for td in some], [td[0] for td in none])


# Action delays and observation delays.


ROUTES = {**DELAYS, "nothing": {}}
ROUTES["links"] = {
    "delay": DelayConfig(obs=2, loss=0.1),
    "links": LinkConfig(kind="matrix", delay=1),
}


@pytest.mark.parametrize("turn", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2, 3))])
@pytest.mark.parametrize("route", ROUTES)
def test_a_step_of_all_transforms_at_once_equals_torchrls_one_by_one(route, turn):
    pairs = [*product(("instant", "polynomial"), ("discrete", "continuous"))]
    motion, kind = pairs[([*ROUTES].index(route) + turn) % 4]  # each route has another one first
    scenario = everything(motion, kind, **ROUTES[route])
    check_equals_torchrls_way(scenario, delayed(scenario))


@pytest.mark.parametrize(
    ("make", "route"),
    [
        (square, "everything"),
        *(pytest.param(everything, r, marks=pytest.mark.slow) for r in ROUTES),
    ],
)
def test_a_compiled_step_equals_torchrls_too(make, route):
    scenario = make(**ROUTES[route], failure=FailureConfig(0.1))
    scenario.motion = replace(FLYING, abort=0.5)
    check_equals_torchrls_way(scenario, delayed(scenario).compile(backend="eager"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["search_and_rescue", "convoy", "patrol", "requests"])
def test_a_scenario_compiles_to_kernels(name):
    scenario = compose_scenario(f"scenario={name}", "delay.obs=1..3", "delay.loss=0.1")
    eager, compiled = (make_env(scenario, 4, seed=0) for _ in range(2))
    compiled.compile()
    actions = choices(eager, 8)
    for expected, found in zip(steps_of(eager, actions), steps_of(compiled, actions), strict=True):
        for key, value in expected.items(True, True):
            torch.testing.assert_close(
                found[key],
                value,
                msg=str(key),
                equal_nan=True,
            )


def check_equals_torchrls_way(scenario, env):
    base = env.base_env
    uav_env = UavEnv(scenario, 4, extras=base.extras, messages_only=base.messages_only)
    one_by_one = TransformedEnv(uav_env, make_transforms(scenario, env.delays, uav_env, EXTRAS))
    for transform in one_by_one.transform:
        transform.set_seed(0)
    one_by_one.append_transform(RewardSum([REWARD], [EPISODE_REWARD]))
    one_by_one.append_transform(StepCounter())
    env.append_transform(EpisodeTotals())  # both in one
    actions = choices(one_by_one, 10)
    expected = steps_of(one_by_one, actions)
    found = steps_of(env, actions)
    assert any(td["next", "done"].any() and not td["next", "done"].all() for td in expected[::2])
    assert all_same(expected, found)


def steps_of(env, actions):
    """What each step returns, and that with which the next one begins, without what a policy has
    written."""
    following = env.reset()
    shown = []
    for t, action in enumerate(actions):
        if t == 3:  # from here on the episode of one world ends at another time than the others
            following = env.reset(following.set("_reset", torch.arange(4).view(4, 1) == 1)).exclude(
                "_reset"
            )
        following = following.clone().set(ACTION, action)
        following.set("policy_note", torch.ones(4)).set(("agents", "logits"), torch.zeros(4, 3, 5))
        after, following = env.step_and_maybe_reset(following)
        for td in (after, following):
            assert {"policy_note", ("agents", "logits")} <= {*td.keys(True, True)}
        shown += [
            td.exclude("policy_note", ACTION, ("agents", "logits")) for td in (after, following)
        ]
    return shown


# Compiled environments.


@both_kinds
def test_random_actions_are_those_that_torchrl_draws(kind):
    env = delayed(square(actions=ActionConfig(kind=kind)))
    step = env.reset()
    torch.manual_seed(5)
    expected = TransformedEnv.rand_action(env, step.clone())
    for given in (step.clone(), None):
        torch.manual_seed(5)
        drawn = env.rand_action(given)
        assert drawn[ACTION].equal(expected[ACTION])
        assert drawn.batch_size == expected.batch_size
        assert drawn["agents"].batch_size == expected["agents"].batch_size
    assert all_same(expected, env.rand_action(step.clone()).set(ACTION, expected[ACTION]))
