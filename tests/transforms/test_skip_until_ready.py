"""A step that lasts until somebody is ready is as good as all the short ones that nobody decides in."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers import everything, same, square
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from damian.common.errors import InputError
from damian.delays.config import DelayConfig
from damian.envs.clocks import ClockConfig
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.envs.scenario import ScenarioConfig
from damian.envs.uav_env import UavEnv
from damian.keys import ACTION, REWARD
from damian.server.termination import EpisodeConfig
from damian.transforms.skip_until_ready import SkipUntilReady
from damian.world.landing import ActionConfig

LATE = {"law": "uniform", "low": 1, "high": 5, "probability": 0.6}
BURST = {"law": "burst", "enter": 0.3, "leave": 0.3, "bad": 4}
ENDS = EpisodeConfig(max_steps=14, discharged_share=1.0)

LATENESS: dict[str, dict[str, Any]] = {
    "nothing": {},
    "messages, lost ones, history": {"delay": DelayConfig(obs=LATE, loss=0.3, history=3)},
    "messages by arrival": {"delay": DelayConfig(obs=LATE, order="arrival", history=2)},
    "bursts": {"delay": DelayConfig(obs=BURST)},
    "actions": {"delay": DelayConfig(act=LATE, obs=LATE, history=2)},
    "rewards": {"delay": DelayConfig(rew=LATE, reward_window=3)},
    "slow clocks": {"clock": ClockConfig(agents="2s", server="4s"), "delay": DelayConfig(obs=LATE)},
    "all of it": {
        "clock": ClockConfig(agents="2s", server="4s"),
        "delay": DelayConfig(obs=LATE, act=BURST, rew=LATE, loss=0.2, history=2, reward_window=2),
    },
}
EXTRAS = ["state", "reward_terms"]
N_WORLDS, N_MOMENTS = 3, 6

Interrupted = Mapping[int, int]
"""After which of its moments a world is reset from outside."""
NEVER: Interrupted = {}


def flights(late: str, motion: str = "polynomial") -> ScenarioConfig:
    actions = ActionConfig(distances=[0.0, 40.0, 80.0])
    scenario = everything(motion, agents=2, actions=actions, episode=ENDS, **LATENESS[late])
    return replace(scenario, motion=replace(scenario.motion, sensing_time=3.0))


def skips(scenario: ScenarioConfig, gamma: float = 1.0) -> ScenarioConfig:
    return replace(scenario, clock=replace(scenario.clock, skip=True, skip_discount=gamma))


def choices(env: DelayedEnv) -> Tensor:
    """What each world does after each of its moments, [N_MOMENTS, B, N]."""
    shape, generator = (N_MOMENTS, *env.batch_size, env.uav_env.n_agents), torch.Generator().manual_seed(3)
    return torch.randint(env.uav_env.scenario.actions.n_actions, shape, generator=generator)


def interrupt(
    env: DelayedEnv, td: TensorDictBase, moments: Tensor, now: Tensor, interrupted: Interrupted
) -> TensorDictBase:
    """Reset the worlds [B] that are at the moment after which this happens."""
    due = torch.tensor([interrupted.get(world, -1) for world in range(len(moments))])
    mask = ((due == moments) & now).unsqueeze(-1)
    return env.reset(td.set("_reset", mask)) if mask.any() else td


def by_leaps(scenario: ScenarioConfig, interrupted: Interrupted) -> list[list[TensorDictBase]]:
    """What each world shows at each of its moments, and thereafter."""
    env = make_env(scenario, N_WORLDS, seed=5, extras=EXTRAS)
    td, actions, shown = env.reset(), choices(env), []
    for i in range(N_MOMENTS):
        after, td = env.step_and_maybe_reset(td.set(ACTION, actions[i]))
        td = interrupt(env, td, torch.full((N_WORLDS,), i + 1), torch.ones(N_WORLDS).bool(), interrupted)
        shown.append([after["next"].clone(), td.exclude(ACTION, "_reset").clone()])
    return [[td[world] for step in shown for td in step] for world in range(N_WORLDS)]


def by_steps(
    scenario: ScenarioConfig, gamma: float, interrupted: Interrupted
) -> tuple[list[list[TensorDictBase]], int]:
    """The same step by step, with arbitrary actions where nobody is ready; and ends where nobody is."""
    env = make_env(scenario, N_WORLDS, seed=5, extras=EXTRAS)
    td, actions, generator = env.reset(), choices(env), torch.Generator().manual_seed(4)
    moments, passed = (torch.zeros(N_WORLDS, dtype=torch.long) for _ in range(2))
    shown: list[list[TensorDictBase]] = [[] for _ in range(N_WORLDS)]
    sums: dict[Any, Tensor] = {}
    ends = 0
    while min(map(len, shown)) < 2 * N_MOMENTS:
        chosen = actions[moments.clamp(max=N_MOMENTS - 1), torch.arange(N_WORLDS)]
        ignored = torch.randint(env.uav_env.scenario.actions.n_actions, chosen.shape, generator=generator)
        chosen = torch.where((passed == 0).unsqueeze(-1), chosen, ignored)
        after, td = env.step_and_maybe_reset(td.set(ACTION, chosen))
        seen = after["next"].clone()
        for key in (k for k in seen.keys(True, True) if k == REWARD or "reward_terms" in k):
            first, weight = (across(x, seen[key]) for x in (passed == 0, gamma**passed))
            share = weight * seen[key]
            sums[key] = torch.where(first, share, sums.get(key, share) + share)
        passed = passed + 1
        sums["duration"] = passed.unsqueeze(-1)
        ready, done = seen["agents", "ready"].any(-1), seen["done"].squeeze(-1)
        now, ends = ready | done, ends + int((done & ~ready).sum())
        moments, passed = moments + now, torch.where(now, 0, passed)
        td = interrupt(env, td, moments, now, interrupted)
        rest = td.exclude(ACTION, "_reset").clone()
        began = done | torch.tensor([interrupted.get(w) == m for w, m in enumerate(moments.tolist())])
        for key, total in sums.items():
            seen[key] = total
            if key != REWARD:  # TorchRL carries no reward over
                rest[key] = torch.where(across(began, total), 0, total)
        for world in now.nonzero().flatten().tolist():
            shown[world] += [seen[world].clone(), rest[world].clone()]
    return [rows[: 2 * N_MOMENTS] for rows in shown], ends


def across(worlds: Tensor, like: Tensor) -> Tensor:
    """A number for each world [B] as [B, 1, ...]."""
    return worlds.view(-1, *[1] * (like.dim() - 1))


def check_equal(
    scenario: ScenarioConfig, gamma: float = 1.0, interrupted: Interrupted = NEVER
) -> tuple[Tensor, int]:
    """Both ways are equal bit for bit; how long the steps were [B, moments], and ends within them."""
    leaps = by_leaps(skips(scenario, gamma), interrupted)
    steps, ends = by_steps(scenario, gamma, interrupted)
    for world, (some, others) in enumerate(zip(leaps, steps, strict=True)):
        for i, (one, other) in enumerate(zip(some, others, strict=True)):
            assert same(one, other), (world, i, differing(one, other))
    return torch.stack([torch.cat([td["duration"] for td in rows[::2]]) for rows in leaps]), ends


def differing(one: TensorDictBase, other: TensorDictBase) -> list[Any]:
    keys = set(one.keys(True, True)) & set(other.keys(True, True))
    return [k for k in keys if not one[k].equal(other[k])] or [set(one.keys()) ^ set(other.keys())]


@pytest.mark.parametrize("late", LATENESS)
def test_a_long_step_shows_what_the_short_ones_would_have_shown(late):
    durations, _ = check_equal(flights(late))
    assert (durations > 1).any()
    assert (durations != durations[:1]).any(), "no world stood still"


def test_an_episode_may_end_while_nobody_is_ready():
    _, ends = check_equal(replace(flights("rewards"), episode=EpisodeConfig(max_steps=5)))
    assert ends


def test_a_world_that_is_reset_among_others_goes_on_as_if_stepped():
    check_equal(flights("messages, lost ones, history"), interrupted={1: 2, 2: 4})


def test_rewards_are_discounted_and_sums_are_equal_too():
    check_equal(flights("all of it"), gamma=0.9)


def test_a_reward_is_discounted_once_for_each_short_step_before_it():
    flying = {"agents": 1, "motion": everything("polynomial").motion}
    action = torch.arange(8, 16).view(8, 1)  # 50 m in each direction
    env, short = (make_env(s, 8) for s in (skips(square(**flying), gamma=0.5), square(**flying)))
    td, now, paid = env.step(env.reset().set(ACTION, action))["next"], short.reset(), torch.zeros(8, 1, 1)
    for k in range(int(td["duration"].max())):
        now = short.step(now.set(ACTION, action))["next"].clone()
        paid += (k < td["duration"]).unsqueeze(-1) * 0.5**k * now[REWARD]
    assert td[REWARD].equal(paid)
    assert (paid != now[REWARD]).any()


def test_instant_motion_has_nothing_to_skip():
    durations, _ = check_equal(flights("messages, lost ones, history", "instant"))
    assert (durations == 1).all()


def test_a_world_alone_does_what_it_does_among_others():
    scenario, seeds = skips(flights("all of it")), torch.tensor([11, 12, 13])
    together = make_env(scenario, N_WORLDS)
    together.seed_worlds(seeds)
    for world in range(N_WORLDS):
        alone = make_env(scenario, 1)
        alone.seed_worlds(seeds[world : world + 1])
        together.seed_worlds(seeds)
        td, one = together.reset(), alone.reset()
        for action in choices(together):
            after, td = together.step_and_maybe_reset(td.set(ACTION, action))
            after_one, one = alone.step_and_maybe_reset(one.set(ACTION, action[world : world + 1]))
            assert same(after["next"][world], after_one["next"][0])


@pytest.mark.parametrize("motion", ["instant", "polynomial"])
def test_specs_hold(motion):
    check_env_specs(make_env(skips(flights("all of it", motion)), 2, extras=EXTRAS))


@pytest.mark.slow
def test_compiled_it_skips_the_same():
    scenario = skips(flights("messages, lost ones, history"))
    eager, fast = make_env(scenario, N_WORLDS, seed=5), make_env(scenario, N_WORLDS, seed=5).compile()
    td, other = eager.reset(), fast.reset()
    for action in choices(eager):
        after, td = eager.step_and_maybe_reset(td.set(ACTION, action))
        after_other, other = fast.step_and_maybe_reset(other.set(ACTION, action))
        assert after["next", "duration"].equal(after_other["next", "duration"])
        torch.testing.assert_close(after["next", *REWARD], after_other["next", *REWARD])


def test_skipped_messages_are_never_missed_in_silence():
    with pytest.raises(InputError, match=r"clock\.skip: True skips steps, but back-updating"):
        make_env(skips(square()), 1, extras=["message"])


@pytest.mark.parametrize(
    ("clock", "told"),
    [
        ({"skip": True, "skip_discount": 1.5}, r"clock\.skip_discount: 1\.5"),
        ({"skip_discount": 0.9}, r"clock\.skip_discount: 0\.9 means nothing without clock\.skip=true"),
    ],
)
def test_an_impossible_discount_is_refused(clock, told):
    with pytest.raises(InputError, match=told):
        ClockConfig(**clock)


@pytest.mark.parametrize("gamma", [-0.1, 1.1])
def test_a_transform_with_an_impossible_discount_is_refused(gamma):
    with pytest.raises(InputError, match=f"gamma: {gamma}"):
        SkipUntilReady(gamma)


def test_where_nothing_can_stand_still_there_is_no_skipping():
    env = TransformedEnv(UavEnv(square(), 2), SkipUntilReady())
    with pytest.raises(RuntimeError, match="SkipUntilReady works only in a DelayedEnv"):
        env.rollout(2)


def test_a_step_of_some_worlds_only_is_refused():
    env = make_env(skips(square()), 2)
    td = env.reset().set(ACTION, torch.zeros(2, 3, dtype=torch.long))
    with pytest.raises(RuntimeError, match="_step"):
        env.step(td.set("_step", torch.tensor([True, False])))
