"""A merged step equals, bit for bit, the single steps in which no UAV is ready to choose an action."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from delay_twin import Crowd
from helpers import all_same, everything
from tensordict import TensorDictBase
from torch import Tensor

from damian.common.tensors import expand_mask
from damian.delays.config import DelayConfig
from damian.envs.config import ClockConfig, ScenarioConfig
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.keys import ACTION, REWARD
from damian.server.termination import EpisodeConfig
from damian.world.landing import ActionConfig

LATE = {"law": "uniform", "low": 1, "high": 5, "probability": 0.6}
BURST = {"law": "burst", "enter": 0.3, "leave": 0.3, "bad": 4}
ENDS = EpisodeConfig(max_steps=14, discharged_share=1.0)

DELAYS: dict[str, dict[str, Any]] = {
    "nothing": {},
    "messages, lost ones, history": {"delay": DelayConfig(obs=LATE, loss=0.3, history=3)},
    "messages by arrival": {"delay": DelayConfig(obs=LATE, order="arrival", history=2)},
    "bursts": {"delay": DelayConfig(obs=BURST)},
    "actions": {"delay": DelayConfig(act=LATE, obs=LATE, history=2)},
    "laws that see the context": {"delay": DelayConfig(obs=Crowd(), act=Crowd(), rew=Crowd(loses=False))},
    "rewards": {"delay": DelayConfig(rew=LATE, reward_window=3)},
    "slow clocks": {"clock": ClockConfig(agents="2s", server="4s"), "delay": DelayConfig(obs=LATE)},
    "all of it": {
        "clock": ClockConfig(agents="2s", server="4s"),
        "delay": DelayConfig(obs=LATE, act=BURST, rew=LATE, loss=0.2, history=2, reward_window=2),
    },
}
EXTRAS = ["state", "reward_terms"]
N_WORLDS, N_DECISIONS = 3, 6

Interrupted = Mapping[int, int]
"""Number of decisions after which a world is reset during its episode, by world."""
NEVER: Interrupted = {}


def flights(delays: str, motion: str = "polynomial") -> ScenarioConfig:
    """A scenario with these delays; after landing, UAVs sense for three seconds."""
    actions = ActionConfig(distances=[0.0, 40.0, 80.0])
    scenario = everything(motion, agents=2, actions=actions, episode=ENDS, **DELAYS[delays])
    return replace(scenario, motion=replace(scenario.motion, sensing_time=3.0))


def skips(scenario: ScenarioConfig, gamma: float = 1.0) -> ScenarioConfig:
    """The same scenario with ``clock.skip``."""
    return replace(scenario, clock=replace(scenario.clock, skip=True, skip_discount=gamma))


def choices(env: DelayedEnv) -> Tensor:
    """Actions of each world at each of its decisions, [N_DECISIONS, B, N]."""
    shape, generator = (N_DECISIONS, *env.batch_size, env.uav_env.n_agents), torch.Generator().manual_seed(3)
    return torch.randint(env.uav_env.scenario.actions.n_actions, shape, generator=generator)


def interrupt(
    env: DelayedEnv, td: TensorDictBase, decisions: Tensor, now: Tensor, interrupted: Interrupted
) -> TensorDictBase:
    """Reset the worlds that have just made (``now`` [B]) the decision after which they are to be reset."""
    due = torch.tensor([interrupted.get(world, -1) for world in range(len(decisions))])
    mask = ((due == decisions) & now).unsqueeze(-1)
    return env.reset(td.set("_reset", mask)) if mask.any() else td


def by_merged_steps(scenario: ScenarioConfig, interrupted: Interrupted) -> list[list[TensorDictBase]]:
    """Outputs of each world after each decision, and the TensorDicts from which it continues."""
    env = make_env(scenario, N_WORLDS, seed=5, extras=EXTRAS)
    td, actions, outputs = env.reset(), choices(env), []
    for i in range(N_DECISIONS):
        after, td = env.step_and_maybe_reset(td.set(ACTION, actions[i]))
        td = interrupt(env, td, torch.full((N_WORLDS,), i + 1), torch.ones(N_WORLDS).bool(), interrupted)
        outputs.append([after["next"].clone(), td.exclude(ACTION, "_reset").clone()])
    return [[td[world] for step in outputs for td in step] for world in range(N_WORLDS)]


def by_single_steps(
    scenario: ScenarioConfig, gamma: float, interrupted: Interrupted
) -> tuple[list[list[TensorDictBase]], int]:
    """As ``by_merged_steps``, but in single steps, with random actions of UAVs that are not ready.

    Also returns the number of episodes that ended while no UAV was ready.
    """
    env = make_env(scenario, N_WORLDS, seed=5, extras=EXTRAS)
    td, actions, generator = env.reset(), choices(env), torch.Generator().manual_seed(4)
    decisions, elapsed = (torch.zeros(N_WORLDS, dtype=torch.long) for _ in range(2))
    outputs: list[list[TensorDictBase]] = [[] for _ in range(N_WORLDS)]
    sums: dict[Any, Tensor] = {}
    ends = 0
    while min(map(len, outputs)) < 2 * N_DECISIONS:
        chosen = actions[decisions.clamp(max=N_DECISIONS - 1), torch.arange(N_WORLDS)]
        ignored = torch.randint(env.uav_env.scenario.actions.n_actions, chosen.shape, generator=generator)
        chosen = torch.where((elapsed == 0).unsqueeze(-1), chosen, ignored)
        after, td = env.step_and_maybe_reset(td.set(ACTION, chosen))
        output = after["next"].clone()
        for key in (k for k in output.keys(True, True) if k == REWARD or "reward_terms" in k):
            first, weight = (expand_mask(x, output[key]) for x in (elapsed == 0, gamma**elapsed))
            discounted = weight * output[key]
            sums[key] = torch.where(first, discounted, sums.get(key, discounted) + discounted)
        elapsed = elapsed + 1
        sums["duration"] = elapsed.unsqueeze(-1)
        ready, done = output["agents", "ready"].any(-1), output["done"].squeeze(-1)
        now, ends = ready | done, ends + int((done & ~ready).sum())
        decisions, elapsed = decisions + now, torch.where(now, 0, elapsed)
        td = interrupt(env, td, decisions, now, interrupted)
        continued = td.exclude(ACTION, "_reset").clone()
        reset = done | torch.tensor([interrupted.get(w) == n for w, n in enumerate(decisions.tolist())])
        for key, total in sums.items():
            output[key] = total
            if key != REWARD:  # TorchRL does not copy rewards to the next root
                continued[key] = torch.where(expand_mask(reset, total), 0, total)
        for world in now.nonzero().flatten().tolist():
            outputs[world] += [output[world].clone(), continued[world].clone()]
    return [rows[: 2 * N_DECISIONS] for rows in outputs], ends


def check_equal(
    scenario: ScenarioConfig, gamma: float = 1.0, interrupted: Interrupted = NEVER
) -> tuple[Tensor, int]:
    """Compare merged and single steps bit for bit.

    Returns the durations of the merged steps [B, N_DECISIONS], and the number of episodes that ended while no
    UAV was ready.
    """
    merged = by_merged_steps(skips(scenario, gamma), interrupted)
    single, ends = by_single_steps(scenario, gamma, interrupted)
    assert all(all_same(some, others) for some, others in zip(merged, single, strict=True))
    return torch.stack([torch.cat([td["duration"] for td in rows[::2]]) for rows in merged]), ends


@pytest.mark.sample(3)
@pytest.mark.parametrize("delays", DELAYS)
def test_a_merged_step_has_the_outputs_of_the_single_steps(delays):
    durations, _ = check_equal(flights(delays), gamma=0.5)  # whose powers are exact in floats
    assert (durations > 1).any()
    assert (durations != durations[:1]).any(), "no world paused"


def test_an_episode_may_end_while_no_uav_is_ready():
    _, ends = check_equal(replace(flights("rewards"), episode=EpisodeConfig(max_steps=5)))
    assert ends


def test_resets_of_some_worlds_during_episodes_give_the_same_outputs():
    check_equal(flights("messages, lost ones, history"), interrupted={1: 2, 2: 4})
