"""Builds a scenario's environment: the one place that decides the order of its delays, losses and
clocks.

What a step passes, in this order (a transform is there only if the scenario asks for it)::

    policy -> action -> ActionDelay -> UavEnv: physics makes messages
    UavEnv -> message -> ObservationDelay -> Belief, ObservationTimeline
                      -> Channel: what UAVs have sent each other directly
                      -> ServerNode: observations, rewards, ends
    reward -> RewardDelay -> CumulativeReward
    observation -> SampleAndHold (server) -> ObservationDelay (broadcast) -> SampleAndHold (agents)
                -> ActionHistory -> policy
"""

from collections.abc import Collection
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.envs import Compose, Transform

from damian import keys
from damian.common import checks
from damian.delays.scenario import ScenarioDelays
from damian.envs.commands import CommandDelay
from damian.envs.config import ScenarioConfig
from damian.envs.delayed_env import DelayedEnv
from damian.envs.forward import Forward, longest_flight
from damian.envs.nodes import Belief, Drop, ServerNode
from damian.envs.uav_env import ALL_EXTRAS, UavEnv
from damian.server.server import Server
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    Channel,
    CumulativeReward,
    ObservationDelay,
    ObservationTimeline,
    RewardDelay,
    SampleAndHold,
)
from damian.world.landing import ActionConfig, action_table, displacement
from damian.world.simulation import Simulation
from damian.world.vehicles import MOTION_MODELS

_STOPS = [keys.STOPS, keys.OWN_STOPS]
"""Entries that only back-updating reads behind the server node."""
_REPORTED = [
    keys.MESSAGE,
    keys.MESSAGE_SENT,
    keys.RECEIVED,
    keys.DELAY,
    keys.LOSS,
    keys.BELIEF,
    keys.OWN_BELIEF,
    *_STOPS,
    keys.RECALLED,
    keys.OWN_RECALLED,
    keys.FORWARD,
    keys.FORWARD_MASK,
]
"""Entries that only the extra ``message`` outputs."""
_LINKED = [keys.LINKED, keys.LINK_DELAY, keys.HEARD_STOPS]
"""Entries from which UAVs that hear each other directly compute what they observe."""


def make_env(
    scenario: ScenarioConfig,
    num_worlds: int = 1,
    seed: int = 0,
    device: torch.device | str = "cpu",
    extras: Collection[str] = (),
) -> DelayedEnv:
    """Build the environment of a scenario with all of its delays.

    The arguments are those of ``UavEnv``. If messages are delayed, the extra ``message`` also
    outputs ``received`` (the messages that the server holds), their ``age`` [steps], and the
    ``delay`` [steps] of the messages sent, and if rewards are delayed, ``reward_delay`` [steps]
    and, without a message delay, ``earned_reward``, all under ``"agents"``.
    """
    extras = checks.names("extras", extras, ALL_EXTRAS)
    delays = scenario.make_delays()
    remote = has_server_node(scenario, delays)
    needed = {*["message"] * remote, *["position"] * delays.reads_positions}
    env = UavEnv(scenario, num_worlds, seed, device, {*extras, *needed}, messages_only=remote)
    pipeline = DelayedEnv(env, make_transforms(scenario, delays, env, extras))
    pipeline.delays = delays
    pipeline.set_seed(seed)
    pipeline.reset()  # allocates the memories of the transforms, and finds entries that are missing
    pipeline.set_seed(seed)
    return pipeline


def make_transforms(
    scenario: ScenarioConfig, delays: ScenarioDelays, env: UavEnv, extras: Collection[str]
) -> Compose:
    """All transforms of a scenario in order: outputs pass them forwards, a policy's actions
    backwards."""
    remote = has_server_node(scenario, delays)
    transforms = [
        *action_transforms(scenario, delays, env.simulation),
        *(server_transforms(scenario, delays, env, extras) if remote else []),
        *reward_transforms(scenario, delays, extras),
        *observation_transforms(scenario, delays),
    ]
    dropped = [
        *_LINKED * (scenario.links.kind == "matrix"),
        *_REPORTED * ("message" not in extras),
        *_STOPS * (not delays.obs.late),
        *[keys.REACH] * scenario.tells_commands,  # the server node has read it
    ]
    if remote and dropped:
        transforms.append(Drop(dropped))
    return Compose(*transforms)  # type: ignore[arg-type]


def action_transforms(
    scenario: ScenarioConfig, delays: ScenarioDelays, simulation: Simulation
) -> list[Transform]:
    """The action delay (paper, section 3.3); actions that a UAV chose while not ready are not
    sent."""
    clock = scenario.clock
    act = delays.act
    if not act.late and clock.steps("agents") == 1:
        return []
    options: dict[str, Any] = {
        "default": hold_action(scenario.actions),
        "sent_key": "ready",
        "valid_key": keys.ACTION_VALID,
        **delays.told,
    }
    if not scenario.tells_commands:
        return [ActionDelay(act, keys.ACTION, **options)]
    n_commands = scenario.latest_commands
    waits = not simulation.vehicles.instant
    return [CommandDelay(act, simulation.candidates, n_commands, waits=waits, **options)]


def server_transforms(
    scenario: ScenarioConfig, delays: ScenarioDelays, env: UavEnv, extras: Collection[str]
) -> list[Transform]:
    """The message delay (paper, section 3.4), links, and the server node, which uses arrived
    messages."""
    server = env.server
    output_messages = "message" in extras
    delayed = delays.obs.late
    links = scenario.links
    forward = scenario.observation.forward and (delayed or scenario.tells_commands)
    remembers = (
        server.grid is not None
        or scenario.delay.messages > 0
        or scenario.observation.timeline > 0
        or forward
    )
    transforms: list[Transform] = []
    if delayed:
        uplink = ObservationDelay(
            delays.obs,
            keys.MESSAGE,
            keys.RECEIVED,
            order=scenario.delay.order,
            sent_key=keys.MESSAGE_SENT,
            age_key=keys.AGE
            if output_messages or history_since_message(scenario, delays)
            else None,
            delay_key=keys.DELAY if output_messages or remembers else None,
            **delays.told,
        )
        transforms.append(uplink)
    longest = delays.obs.longest if delayed else 0
    transforms += remembering_transforms(scenario, server, longest, delayed)
    held = keys.RECEIVED if delayed else keys.MESSAGE
    heard = None
    if links.kind == "matrix":
        heard = keys.LINKED
        law = delays.links
        channel = Channel(
            law,
            keys.MESSAGE,
            heard,
            comm_range=links.range,
            position_key=keys.POSITION if law.reads or links.range is not None else None,
            sent_key=keys.MESSAGE_SENT,
            dt=scenario.clock.dt,
            age_key=None,
            delay_key=keys.LINK_DELAY if scenario.observation.timeline else None,
        )
        transforms.append(channel)
        transforms += timeline_transforms(
            scenario, server, keys.HEARD_STOPS, keys.LINK_DELAY, group=True
        )
    if forward:
        transforms += forward_transforms(scenario, delays, env, held, masks=output_messages)
        heard = keys.FORWARD
    node = ServerNode(
        server,
        held,
        heard_key=heard,
        reward_terms="reward_terms" in extras,
        simulation=env.simulation if scenario.tells_commands else None,
    )
    return [*transforms, node]


def forward_transforms(
    scenario: ScenarioConfig,
    delays: ScenarioDelays,
    env: UavEnv,
    held: NestedKey,
    *,
    masks: bool,
) -> list[Transform]:
    """What flies late messages forward, and before it what keeps those of the latest steps."""
    steps = scenario.observation.forward_steps
    if not delays.obs.loses:  # what has been sent before has arrived
        steps = min(steps, delays.obs.longest + longest_flight(env.simulation))
    recalled = ObservationTimeline(
        steps + 1,
        keys.MESSAGE,
        keys.RECALLED,
        delay_key=keys.DELAY if delays.obs.late else None,
        sent_key=keys.MESSAGE_SENT,
        own_key=keys.OWN_RECALLED,
    )
    masks = masks and scenario.actions.kind == "discrete" and scenario.actions.mask
    late = delays.act.longest if scenario.tells_commands else 0
    hold = hold_action(scenario.actions)
    forward = Forward(env.simulation, held, masks=masks, late=late, hold=hold)
    return [recalled, forward]


def remembering_transforms(
    scenario: ScenarioConfig, server: Server, longest: int, delayed: bool
) -> list[Transform]:
    """What keeps messages of earlier steps: the belief, and the history to learn a belief from."""
    own = scenario.observation.own
    delay_key = keys.DELAY if delayed else None
    transforms = list[Transform]()
    if server.grid is not None:
        transforms.append(Belief(server, longest, delayed=delayed, own=own))
    if scenario.delay.messages:
        history = ObservationTimeline(
            scenario.delay.messages,
            keys.MESSAGE,
            keys.TIMELINE,
            delay_key=delay_key,
            sent_key=keys.MESSAGE_SENT,
            encode=partial(scaled_messages, server),
            group=True,
            own=own,
        )
        transforms.append(history)
    own_key = keys.OWN_STOPS if own else None
    transforms += timeline_transforms(scenario, server, keys.STOPS, delay_key, own_key=own_key)
    return transforms


def timeline_transforms(
    scenario: ScenarioConfig,
    server: Server,
    out_key: NestedKey,
    delay_key: NestedKey | None,
    *,
    group: bool = False,
    own_key: NestedKey | None = None,
) -> list[Transform]:
    """What is known of the stops of the latest steps, for the feature ``timeline``, if it is
    observed."""
    if not scenario.observation.timeline:
        return []
    timeline = ObservationTimeline(
        scenario.observation.timeline,
        keys.MESSAGE,
        out_key,
        delay_key=delay_key,
        sent_key=keys.MESSAGE_SENT,
        encode=server.stop_facts,
        ages=server.stop_ages,
        group=group,
        own_key=own_key,
    )
    return [timeline]


def scaled_messages(server: Server, rows: Tensor) -> Tensor:
    """Position and way to the target (over the region's size), spotted and battery, [*, N, 6]."""
    messages = server.messages(rows)
    scale = server.scales(messages)[..., None, None]
    way = messages.target - messages.position
    flags = torch.stack([messages.spotted, messages.battery / 100], -1)
    return torch.cat([messages.position / scale, way / scale, flags], -1)


def reward_transforms(
    scenario: ScenarioConfig, delays: ScenarioDelays, extras: Collection[str]
) -> list[Transform]:
    """The reward delay, and the discounted sum of the latest rewards
    (paper, section 3.5, eq. 4)."""
    delay = scenario.delay
    reported = "message" in extras
    transforms: list[Transform] = []
    if delays.rew.late:
        # With a message delay the server computes in hindsight what was earned.
        earned_key = keys.EARNED_REWARD if reported and not delays.obs.late else None
        late = RewardDelay(
            delays.rew,
            keys.REWARD,
            delay_key=keys.REWARD_DELAY if reported else None,
            earned_key=earned_key,
            **delays.told,
        )
        transforms.append(late)
    if delay.reward_window > 1:
        transforms.append(CumulativeReward(delay.reward_window, delay.reward_discount, keys.REWARD))
    return transforms


def observation_transforms(scenario: ScenarioConfig, delays: ScenarioDelays) -> list[Transform]:
    """Clocks of server and UAVs (paper, section 3.6), the broadcast, and the action history
    (section 3.3)."""
    clock = scenario.clock
    links = scenario.links
    n_actions = scenario.delay.history
    transforms: list[Transform] = []
    broadcast = [keys.OBSERVATION, *[keys.TIMELINE] * bool(scenario.delay.messages)]
    if clock.steps("server") > 1:
        transforms.append(
            SampleAndHold(clock.steps("server"), [*broadcast, keys.GLOBAL_OBSERVATION])
        )
    if links.kind == "updown" and delays.links.late:
        downlink = ObservationDelay(
            delays.links,
            keys.OBSERVATION,
            order=scenario.delay.order,
            age_key=None,
            **delays.told,
        )
        transforms.append(downlink)
    if clock.steps("agents") > 1:
        transforms.append(SampleAndHold(clock.steps("agents"), broadcast, ready_key=keys.READY))
    if n_actions:
        history = ActionHistory(
            n_actions,
            keys.ACTION,
            append_to=keys.OBSERVATION,
            codes=action_codes(scenario.actions),
            default=hold_action(scenario.actions),
            recorded_key="ready",
            age_key=keys.AGE if history_since_message(scenario, delays) else None,
            # Features do not reflect a flight before it has ended, though a message is sent as it
            # begins.
            reflected_after=1
            if MOTION_MODELS.get(scenario.motion.kind, "motion.kind").instant
            else 2,
        )
        transforms.append(history)
    return transforms


def history_since_message(scenario: ScenarioConfig, delays: ScenarioDelays) -> bool:
    """Whether an action history holds only actions newer than the message that the server holds.

    Not where a UAV cannot tell which are newer (slow clocks, delayed actions), or knows its own
    message.
    """
    clock = scenario.clock
    slow = clock.steps("server") > 1 or clock.steps("agents") > 1 or scenario.links.kind != "server"
    tells = scenario.delay.history > 0 and not scenario.observation.own and not slow
    return tells and delays.obs.late and not delays.act.late


def has_server_node(scenario: ScenarioConfig, delays: ScenarioDelays) -> bool:
    """Whether a ``ServerNode`` computes observations and rewards, instead of ``UavEnv``."""
    observation = scenario.observation
    forgets = observation.timeline > observation.carried_stops  # one message does not tell it all
    remembers = bool(observation.belief) or scenario.delay.messages > 0 or forgets
    sees_commands = scenario.tells_commands
    return delays.obs.late or remembers or sees_commands or scenario.links.kind == "matrix"


def hold_action(actions: ActionConfig) -> int:
    """Index of the first discrete action that holds the position; 0 if there is none, or if
    continuous."""
    discrete = actions.kind == "discrete" and 0.0 in actions.distances
    return actions.distances.index(0.0) * len(actions.headings) if discrete else 0


def action_codes(actions: ActionConfig) -> Tensor | None:
    """Codes of discrete actions, whose sums tell where a UAV is: displacements in [0, 1],
    [A, 2]."""
    if actions.kind == "continuous":
        return None
    distance, heading = action_table(actions).unbind(-1)
    return (displacement(distance / distance.max(), heading) + 1) / 2
