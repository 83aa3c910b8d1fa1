"""A scenario's environment with its delays, losses and clocks: the one place that knows their order."""

from collections.abc import Collection
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import Compose, Transform

from damian.common import checks
from damian.delays.laws import law_of
from damian.envs.delayed_env import ACTION, DelayedEnv
from damian.envs.scenario import ScenarioConfig
from damian.envs.uav_env import UavEnv
from damian.server.server import Server
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    Clock,
    CumulativeReward,
    ObservationDelay,
    RewardDelay,
    ServerNode,
)
from damian.transforms.skip_until_ready import FastForward
from damian.world.landing import ActionConfig

REWARD, SEEN = ("agents", "reward"), ("agents", "observation")


def make_env(
    scenario: ScenarioConfig,
    num_worlds: int = 1,
    seed: int = 0,
    device: torch.device | str = "cpu",
    extras: Collection[str] = (),
) -> DelayedEnv:
    """The environment of a scenario with everything that is late in it.

    Args:
        scenario: with its ``delay`` and ``clock``.
        num_worlds: B.
        seed: of the worlds, and of the delays.
        device: where everything lives.
        extras: as in ``UavEnv``; with ``message`` also ``received`` (what the
            server holds), its ``age`` [steps], and the ``delay`` of what is sent, under ``"agents"``.

    Raises:
        InputError: the scenario asks for something impossible, or for messages between skipped steps.
    """
    should = "skips steps, but back-updating and evaluation need the messages of every one"
    checks.require(not (scenario.clock.skip and "message" in extras), "clock.skip", True, should)
    late = messages_are_late(scenario)
    shown = {*extras, "message"} if late else extras
    env = UavEnv(scenario, num_worlds, seed, device, shown, serves=not late)
    delayed = DelayedEnv(env, chain(scenario, env.server, extras))
    delayed.set_seed(seed)
    return delayed


def chain(scenario: ScenarioConfig, server: Server, extras: Collection[str]) -> Compose:
    """The transforms of a scenario in their order; what the policy chooses passes them backwards."""
    served = serving(scenario, server, extras) if messages_are_late(scenario) else []
    parts = [*deciding(scenario), *served, *paying(scenario), *seeing(scenario)]
    parts += skipping(scenario, extras)
    return Compose(*parts)  # type: ignore[arg-type]


def deciding(scenario: ScenarioConfig) -> list[Transform]:
    """Actions on their way to the UAVs; one that was not ready when it chose has chosen nothing."""
    delay, clock = scenario.delay, scenario.clock
    if not is_late(delay.act, clock.dt) and clock.steps("agents") == 1:
        return []
    act = law_of(delay.act, "delay.act")
    hold = holding(scenario.actions)
    return [ActionDelay(act, ACTION, default=hold, dt=clock.dt, sent_key="ready", fresh_key="acts")]


def messages_are_late(scenario: ScenarioConfig) -> bool:
    """Does the server hold anything else than what was just sent."""
    return scenario.delay.loss > 0 or is_late(scenario.delay.uplink, scenario.clock.dt)


def serving(scenario: ScenarioConfig, server: Server, extras: Collection[str]) -> list[Transform]:
    """Messages on their way to the server node, and what it makes of those that have arrived."""
    delay = scenario.delay
    uplink = ObservationDelay(
        delay.uplink,
        [("agents", "message")],
        [("agents", "received")],
        loss=delay.loss,
        order=delay.order,
        dt=scenario.clock.dt,
        sent_key="talks",
        age_key="age" if "message" in extras or remembers_unknown(scenario) else None,
        delay_key="delay" if "message" in extras else None,
    )
    unread = [] if "message" in extras else [("agents", k) for k in ("message", "received", "talks")]
    return [uplink, ServerNode(server, drop=unread, terms="reward_terms" in extras)]


def paying(scenario: ScenarioConfig) -> list[Transform]:
    """Rewards on their way."""
    delay, dt = scenario.delay, scenario.clock.dt
    late = [RewardDelay(law_of(delay.rew, "delay.rew"), REWARD, dt=dt)] if is_late(delay.rew, dt) else []
    window = delay.reward_window
    summed = [CumulativeReward(window, delay.reward_discount, REWARD)] if window > 1 else []
    return [*late, *summed]


def seeing(scenario: ScenarioConfig) -> list[Transform]:
    """When the server broadcasts, when the UAVs listen, and what they remember by themselves."""
    clock, n_actions = scenario.clock, scenario.delay.history
    transforms: list[Transform] = []
    if clock.steps("server") > 1:
        transforms.append(Clock(clock.steps("server"), [SEEN, ("agents", "global_observation")]))
    if clock.steps("agents") > 1:
        transforms.append(Clock(clock.steps("agents"), [SEEN], ready_key=("agents", "ready")))
    if n_actions:
        history = ActionHistory(
            n_actions,
            ACTION,
            append_to=SEEN,
            codes=action_codes(scenario.actions),
            default=holding(scenario.actions),
            recorded_key="ready",
            age_key="age" if remembers_unknown(scenario) else None,
        )
        transforms.append(history)
    return transforms


def skipping(scenario: ScenarioConfig, extras: Collection[str]) -> list[Transform]:
    """Steps in which nobody can choose."""
    if not scenario.clock.skip:
        return []
    named = scenario.task.terms if "reward_terms" in extras else []
    terms = [("agents", "reward_terms", name) for name in named]
    return [FastForward(scenario.clock.skip_discount, [REWARD, *terms])]


def remembers_unknown(scenario: ScenarioConfig) -> bool:
    """Is a UAV's memory of its actions one of those that the server, as it answers, cannot know of?

    With late actions or slow clocks nobody knows which these are, and it is one of all; so it is if the UAV
    knows where it is without them.
    """
    delay, clock = scenario.delay, scenario.clock
    prompt = not is_late(delay.act, clock.dt) and clock.steps("server") == clock.steps("agents") == 1
    blind = not scenario.observation.own
    return delay.history > 0 and blind and prompt and messages_are_late(scenario)


def is_late(law: Any, dt: float) -> bool:
    """Does a law, as a person writes it, delay anything."""
    return law_of(law).sampler(dt).certain != 0


def holding(actions: ActionConfig) -> int:
    """The action that holds the position, or the first one if there is none (discrete); distance 0."""
    discrete = actions.kind == "discrete" and 0.0 in actions.distances
    return actions.distances.index(0.0) * len(actions.headings) if discrete else 0


def action_codes(actions: ActionConfig) -> Tensor | None:
    """Discrete actions as an actor sees its past ones: how far east and north, each in [0, 1], [A, 2].

    Displacements, not distance and heading: where a UAV must be by now is then a sum over what it sees.
    """
    if actions.kind == "continuous":
        return None  # they are just that
    distance, heading = actions.table().unbind(-1)
    there = torch.stack([heading.sin(), heading.cos()], -1) * (distance / distance.max()).unsqueeze(-1)
    return (there + 1) / 2
