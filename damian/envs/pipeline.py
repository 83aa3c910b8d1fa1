"""A scenario's environment with its delays, losses and clocks: the one place that knows their order."""

from collections.abc import Collection
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import Compose, Transform

from damian import keys
from damian.common import checks
from damian.delays.laws import law_of
from damian.envs.delayed_env import DelayedEnv
from damian.envs.scenario import ScenarioConfig, make_server, make_simulation
from damian.envs.uav_env import UavEnv
from damian.server.server import Server
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    CumulativeReward,
    ObservationDelay,
    RewardDelay,
    SampleAndHold,
    ServerNode,
)
from damian.transforms.skip_until_ready import SkipUntilReady
from damian.world.landing import ActionConfig


def make_env(
    scenario: ScenarioConfig,
    num_worlds: int = 1,
    seed: int = 0,
    device: torch.device | str = "cpu",
    extras: Collection[str] = (),
) -> DelayedEnv:
    """The environment of a scenario with all of its delays.

    Args:
        scenario: with its ``delay`` and ``clock``.
        num_worlds: B.
        seed: of the worlds, and of the delays.
        device: of all tensors.
        extras: as in ``UavEnv``; with ``message`` also ``received`` (the messages that the server holds),
            their ``age`` [steps], and the ``delay`` of the messages sent, under ``"agents"``.

    Raises:
        InputError: the scenario asks for something impossible, or for the messages of skipped steps.
    """
    should = "skips steps, but back-updating and evaluation need the messages of every one"
    checks.require(not (scenario.clock.skip and "message" in extras), "clock.skip", True, should)
    delayed = has_message_delay(scenario)
    simulation = make_simulation(scenario, seed)
    server = make_server(scenario, simulation)
    env = UavEnv(
        scenario,
        num_worlds,
        seed,
        device,
        {*extras, "message"} if delayed else extras,
        simulation=simulation,
        server=server,
        messages_only=delayed,
    )
    pipeline = DelayedEnv(env, make_transforms(scenario, server, extras))
    pipeline.set_seed(seed)
    return pipeline


def make_transforms(scenario: ScenarioConfig, server: Server, extras: Collection[str]) -> Compose:
    """The transforms of a scenario in their order; a policy's action passes them backwards."""
    transforms = [
        *action_transforms(scenario),
        *(server_transforms(scenario, server, extras) if has_message_delay(scenario) else []),
        *reward_transforms(scenario),
        *observation_transforms(scenario),
        *skip_transforms(scenario, extras),
    ]
    return Compose(*transforms)  # type: ignore[arg-type]


def action_transforms(scenario: ScenarioConfig) -> list[Transform]:
    """The delay of actions; a UAV that was not ready when it chose sends none."""
    delay, clock = scenario.delay, scenario.clock
    if not has_delay(delay.act, clock.dt) and clock.steps("agents") == 1:
        return []
    law, hold = law_of(delay.act, "delay.act"), hold_action(scenario.actions)
    return [
        ActionDelay(
            law, keys.ACTION, default=hold, dt=clock.dt, sent_key="ready", valid_key=keys.ACTION_VALID
        )
    ]


def server_transforms(scenario: ScenarioConfig, server: Server, extras: Collection[str]) -> list[Transform]:
    """The delay of messages to the server node, and its outputs for those that have arrived."""
    delay, read = scenario.delay, "message" in extras
    uplink = ObservationDelay(
        delay.uplink,
        [keys.MESSAGE],
        [keys.RECEIVED],
        loss=delay.loss,
        order=delay.order,
        dt=scenario.clock.dt,
        sent_key=keys.MESSAGE_SENT,
        age_key=keys.AGE if read or history_since_message(scenario) else None,
        delay_key=keys.DELAY if read else None,
    )
    unread = [] if read else [keys.MESSAGE, keys.RECEIVED, keys.MESSAGE_SENT]
    return [uplink, ServerNode(server, dropped_keys=unread, reward_terms="reward_terms" in extras)]


def reward_transforms(scenario: ScenarioConfig) -> list[Transform]:
    """The delay of rewards, and their discounted sum."""
    delay, dt = scenario.delay, scenario.clock.dt
    transforms: list[Transform] = []
    if has_delay(delay.rew, dt):
        transforms.append(RewardDelay(law_of(delay.rew, "delay.rew"), keys.REWARD, dt=dt))
    if delay.reward_window > 1:
        transforms.append(CumulativeReward(delay.reward_window, delay.reward_discount, keys.REWARD))
    return transforms


def observation_transforms(scenario: ScenarioConfig) -> list[Transform]:
    """The clocks of the server and of the UAVs, and the UAVs' action history."""
    clock, n_actions = scenario.clock, scenario.delay.history
    transforms: list[Transform] = []
    if clock.steps("server") > 1:
        observations = [keys.OBSERVATION, keys.GLOBAL_OBSERVATION]
        transforms.append(SampleAndHold(clock.steps("server"), observations))
    if clock.steps("agents") > 1:
        transforms.append(SampleAndHold(clock.steps("agents"), [keys.OBSERVATION], ready_key=keys.READY))
    if n_actions:
        history = ActionHistory(
            n_actions,
            keys.ACTION,
            append_to=keys.OBSERVATION,
            codes=action_codes(scenario.actions),
            default=hold_action(scenario.actions),
            recorded_key="ready",
            age_key=keys.AGE if history_since_message(scenario) else None,
        )
        transforms.append(history)
    return transforms


def skip_transforms(scenario: ScenarioConfig, extras: Collection[str]) -> list[Transform]:
    """Steps that last until some UAV can choose."""
    if not scenario.clock.skip:
        return []
    names = scenario.reward.terms if "reward_terms" in extras else []
    terms = [(*keys.REWARD_TERMS, name) for name in names]
    return [SkipUntilReady(scenario.clock.skip_discount, [keys.REWARD, *terms])]


def history_since_message(scenario: ScenarioConfig) -> bool:
    """Does a UAV's action history hold only the actions that the server's answer cannot reflect yet?

    With delayed actions or slow clocks a UAV cannot tell which these are, and a UAV that knows its own
    messages needs no such choice: then the history holds all of the latest actions.
    """
    delay, clock = scenario.delay, scenario.clock
    prompt = not has_delay(delay.act, clock.dt) and clock.steps("server") == clock.steps("agents") == 1
    return delay.history > 0 and not scenario.observation.own and prompt and has_message_delay(scenario)


def has_message_delay(scenario: ScenarioConfig) -> bool:
    """May the server hold another message of a UAV than the one that it sent in this step?"""
    return scenario.delay.loss > 0 or has_delay(scenario.delay.uplink, scenario.clock.dt)


def has_delay(law: Any, dt: float) -> bool:
    """Does a law, as a person writes it, ever delay anything?"""
    return law_of(law).sampler(dt).certain != 0


def hold_action(actions: ActionConfig) -> int:
    """The discrete action that holds the position, or the first one if there is none; 0 if continuous."""
    discrete = actions.kind == "discrete" and 0.0 in actions.distances
    return actions.distances.index(0.0) * len(actions.headings) if discrete else 0


def action_codes(actions: ActionConfig) -> Tensor | None:
    """Discrete actions as an actor sees its past ones: displacement east and north, each in [0, 1], [A, 2].

    Displacements rather than distance and heading, because their sum tells where a UAV must be by now. None
    for continuous actions, which are shown as they are.
    """
    if actions.kind == "continuous":
        return None
    distance, heading = actions.table().unbind(-1)
    there = torch.stack([heading.sin(), heading.cos()], -1) * (distance / distance.max()).unsqueeze(-1)
    return (there + 1) / 2
