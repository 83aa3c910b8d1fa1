"""Absolute commands: they lead to the same place wherever they arrive, and agents know what they
have sent."""

import math
from dataclasses import replace

import pytest
import shapely
import torch
from helpers import both_kinds, both_motions, corners, everything, play, random_actions, square
from torchrl.envs.utils import check_env_specs

from damian import ClockConfig, UavEnv, make_env
from damian.baselines.script import script_policy
from damian.common.errors import InputError
from damian.delays.config import DelayConfig, LinkConfig
from damian.delays.samplers import Sampler
from damian.envs.commands import destination
from damian.keys import ACTION, ACTION_MASK, COMMANDS, FRAME, GLOBAL_OBSERVATION, OBSERVATION
from damian.server.config import EpisodeConfig, ObservationConfig, RewardConfig
from damian.world.config import (
    ActionConfig,
    BatteryConfig,
    MotionConfig,
    RegionConfig,
    WindConfig,
)
from damian.world.landing import action_table

ABSOLUTE = ActionConfig(command="absolute")
LONG = EpisodeConfig(max_steps=1000)
OBSERVED = (OBSERVATION, GLOBAL_OBSERVATION)
WIDE = RegionConfig(kind="vertices", vertices=corners(0, 0, 600, 600), lattice_step=40.0)


class Scripted(Sampler):
    """The delays of a list, one after the other; 3 for a lost one."""

    def __init__(self, delays):
        super().__init__(2)
        self.delays = torch.tensor(delays)

    def forward(self, streams, clock, state, context=None):
        return self.delays[clock % len(self.delays)].expand_as(streams), state


PUNCTUAL = Scripted([0])
"""Delays that may be late, and never are."""

FLIGHTS = MotionConfig(kind="polynomial", max_speed=20.0, max_acceleration=10.0)
WORLDS = {
    "everything": {},
    "zones": {"region": RegionConfig(min_area=60_000, max_area=90_000, zones=2)},
    "unequal UAVs in wind": {
        "motion": replace(FLIGHTS, max_speed=[10.0, 15.0, 20.0]),
        "wind": WindConfig(speed=8.0, direction=30.0, gusts=1.0),
    },
}


@pytest.mark.parametrize("name", WORLDS)
@both_kinds
def test_an_absolute_command_that_arrives_at_once_is_the_relative_one(name, kind):
    scenario = replace(everything(kind=kind), **WORLDS[name])
    env = UavEnv(scenario, 8)
    env.reset()
    relative = absolute = env.worlds
    generator = torch.Generator().manual_seed(0)
    for t in range(15):
        action = random_actions(env, generator)
        goal = env.simulation.layout.unpack(absolute).goal
        command = torch.stack([goal, torch.full_like(goal, t + 1), goal], -1).unsqueeze(-2)
        relative, outputs = env.step_fn(relative, action)
        absolute, same = env.step_fn(absolute, action, None, command)
        assert all(one.equal(other) for one, other in zip(relative, absolute, strict=True))
        assert all(outputs[key].equal(same[key]) for key in outputs)


@pytest.mark.parametrize(
    ("motion", "kind"),
    [
        ("instant", "continuous"),
        ("polynomial", "discrete"),
    ],
)
def test_with_commands_that_arrive_at_once_agents_see_what_they_saw_without(motion, kind):
    shown = []
    for command in ("relative", "absolute"):
        delay = DelayConfig(act=PUNCTUAL, obs=2)
        scenario = everything(motion, kind, delay=delay)
        scenario.observation.own = True
        scenario.actions = ActionConfig(kind, command=command)
        env = make_env(scenario, 4)
        generator = torch.Generator().manual_seed(0)
        outputs = play(env, lambda _: random_actions(env.uav_env, generator), 12)  # noqa: B023
        shown.append(torch.stack([td.exclude(FRAME, COMMANDS) for td in outputs[1::2]]))
    relative, absolute = shown
    for key in relative.keys(True, True):
        if key != GLOBAL_OBSERVATION:  # without commands, the critic knows no message at once
            assert relative[key].equal(absolute[key]), key


def free_actions(env, frame, generator):
    """Random actions [B, N] of which none leads to where another UAV is or will be."""
    candidates = env.uav_env.simulation.candidates
    n = frame.shape[1]
    while True:
        action = random_actions(env.uav_env, generator)
        goal = destination(candidates, frame, action)
        others = torch.eye(n) == 0
        clash = (goal.unsqueeze(-1) == frame.unsqueeze(-2)) & others.bool()
        clash |= (goal.unsqueeze(-1) == goal.unsqueeze(-2)) & others.bool()
        if not clash.any():
            return action


@pytest.mark.parametrize(
    ("obs", "act", "own"),
    [
        (0, 2, True),
        (2, 1, False),
        (1, 3, False),
        (1, 3, True),
    ],
)
def test_a_delay_of_held_commands_is_a_longer_delay_of_what_is_observed(obs, act, own):
    names = ["others", "coverage_map"]
    observation = ObservationConfig(["place", "number"], names, timeline=8, stops=8, window=3)
    common = {"region": WIDE, "observation": observation, "episode": LONG}
    common["reward"] = RewardConfig(spotted=0.0, coverage=1.0)
    observation.own = own
    law = f"0..{act}"
    late = DelayConfig(obs=obs, act=law, act_hold="max")
    message = {"extras": ["message"]}
    commanded = make_env(square(**common, delay=late, actions=ABSOLUTE), 2, **message)
    observation.own = True
    watched = make_env(square(**common, delay=DelayConfig(obs=obs + act)), 2, **message)
    scripts = script_policy(commanded), script_policy(watched)
    generator = torch.Generator().manual_seed(1)
    first = commanded.reset()
    second = watched.reset()
    hold = torch.zeros(2, 3, dtype=torch.long)
    for _ in range(act):
        second = watched.step(second.set(ACTION, hold))["next"]
    for t in range(12):
        one = {
            block.name: block.of(first[OBSERVATION]) for block in commanded.layout["observation"]
        }
        other = {
            block.name: block.of(second[OBSERVATION]) for block in watched.layout["observation"]
        }
        assert first[FRAME].equal(watched.uav_env.state.goal)
        for name in ["place", "number", *names]:
            assert one[name].equal(other[name]), (t, name)
        told = one["timeline"][..., : 8 - act, :]
        assert told.equal(other["timeline"][..., act:8, :])
        assert first[ACTION_MASK].equal(second[ACTION_MASK])
        scripted = (
            script(td.clone())[ACTION] for script, td in zip(scripts, (first, second), strict=True)
        )
        assert next(scripted).equal(next(scripted))
        action = free_actions(commanded, first[FRAME], generator)
        first = commanded.step(first.set(ACTION, action))["next"]
        second = watched.step(second.set(ACTION, action))["next"]


class Twin:
    """UAVs in one convex world, in plain Python: where commands take them, and where they decide
    from."""

    def __init__(self, env, world, longest):
        simulation = env.uav_env.simulation
        self.points = simulation.airspace.exact_points[0].tolist()
        self.polygon = simulation.airspace.regions[0].polygon
        self.table = action_table(env.uav_env.scenario.actions, torch.float64).tolist()
        self.goal = env.uav_env.state.goal[world].tolist()
        self.longest = longest
        self.sent = [[] for _ in self.goal]
        self.executed = [0 for _ in self.goal]

    def frame(self, uav, now):
        """Where the newest command that may still be executed leads; else where the UAV stands."""
        number, _, wishes = self.sent[uav][-1] if self.sent[uav] else (0, None, None)
        if number > self.executed[uav] and number + self.longest > now:
            return wishes[0]
        return self.goal[uav]

    def nearest(self, target):
        """All points, those at the smallest distance in centimetres first, by their number."""
        ways = [math.floor(100 * math.dist(point, target) + 0.500001) for point in self.points]
        return sorted(range(len(ways)), key=lambda point: (ways[point], point))

    def step(self, now, actions, delay, ready):
        """Send commands, which are lost with a delay of None, and fly where those lead that
        arrive."""
        for uav, action in enumerate(actions if ready else []):
            frame = self.frame(uav, now - 1)
            east, north = self.points[frame]
            distance, heading = self.table[action]
            target = [east + distance * math.sin(heading), north + distance * math.cos(heading)]
            inside = self.polygon.contains(shapely.Point(target))
            wishes = self.nearest(target) if inside else [frame]
            self.sent[uav].append((now, None if delay is None else now + delay, wishes))
        standing = list(self.goal)
        for uav, sent in enumerate(self.sent):
            arrived = [each for each in sent if each[1] == now and each[0] > self.executed[uav]]
            if arrived:
                self.executed[uav], _, wishes = arrived[-1]
                taken = {*self.goal[:uav], *standing[:uav], *standing[uav + 1 :]}
                free = (point for point in wishes if point not in taken)
                self.goal[uav] = next(free, self.goal[uav])


@pytest.mark.parametrize(
    ("hold", "period"),
    [
        ("none", 1),
        ("none", 3),
        ("max", 1),
    ],
)
@pytest.mark.parametrize("delays", [[0, 2, 1, 2, 0], [1, 2, 3, 0, 2, 3, 3, 1]])
def test_uavs_fly_where_commands_lead_that_come_late_or_overtake_or_are_lost(delays, hold, period):
    law = Scripted(delays)
    late = DelayConfig(act=law, act_hold=hold)
    observation = ObservationConfig(["place"], own=True, stops=4)
    common = {"delay": late, "observation": observation, "actions": ABSOLUTE, "episode": LONG}
    common["clock"] = ClockConfig(agents=f"{period}s")
    env = make_env(square(**common), 3)
    generator = torch.Generator().manual_seed(2)
    td = env.reset()
    twins = [Twin(env, world, law.longest) for world in range(3)]
    for now in range(1, 25):
        action = random_actions(env.uav_env, generator)
        ready = (now - 1) % period == 0
        assert (td["agents", "ready"] == ready).all()
        td = env.step(td.set(ACTION, action))["next"]
        drawn = delays[now % len(delays)]
        delay = None if drawn == 3 else law.longest if hold == "max" else drawn
        for world, twin in enumerate(twins):
            twin.step(now, action[world].tolist(), delay, ready)
            assert env.uav_env.state.goal[world].tolist() == twin.goal
            assert td[FRAME][world].tolist() == [twin.frame(uav, now) for uav in range(3)]
    assert len({tuple(twin.goal) for twin in twins}) > 1


def test_a_command_whose_place_is_out_of_reach_holds():
    battery = BatteryConfig(enabled=True, capacity_kwh=0.05)
    scenario = square(region=WIDE, battery=battery)
    env = UavEnv(scenario, 1)
    env.reset()
    simulation = env.simulation
    state = env.state._replace(goal=torch.tensor([[0, 1, 2]]))
    distance = simulation.candidates.distance[:, 0]
    far = int(simulation.points.square().sum(-1).argmax())
    command = torch.tensor([[[[far, 1, 0]], [[far, 1, 0]], [[1, 0, 0]]]])
    action = torch.zeros(1, 3, dtype=torch.long)
    flown = simulation.decide(state, action, None, command)
    assert flown.goal[0, 0] == far
    assert distance[far] == 0
    weak = state._replace(battery=torch.full((1, 3), 3.0))
    assert simulation.vehicles.reach(weak).amax() < simulation.airspace.length(
        torch.tensor(0), torch.tensor(far)
    )
    held = simulation.decide(weak, action, None, command)
    assert held.goal.equal(state.goal)
    assert held.sent.executed.shape[-1] == 0


@pytest.mark.sample(2)
@both_kinds
@both_motions
def test_the_specs_are_right_with_absolute_commands(motion, kind):
    late = DelayConfig(obs="0..2", act="1..3", act_loss=0.2, loss=0.1)
    scenario = everything(motion, kind, delay=late, actions=ActionConfig(kind, command="absolute"))
    scenario.observation.intent = True
    check_env_specs(make_env(scenario, 2, extras=["message"]), seed=0, break_when_any_done="both")


@pytest.mark.parametrize(
    ("motion", "step"),
    [
        ("instant", 4),
        ("polynomial", 0),
    ],
)
def test_nobody_sees_what_another_uav_has_sent_before_a_message_tells_of_it(motion, step):
    late = DelayConfig(obs=1, act=2)
    near = replace(ABSOLUTE, distances=[0.0, 40.0])
    scenario = everything(motion, delay=late, actions=near, episode=LONG)
    scenario.observation.own = True
    shown = []
    for changed in (False, True):
        env = make_env(scenario, 4)
        generator = torch.Generator().manual_seed(3)
        actions = [random_actions(env.uav_env, generator) for _ in range(8)]
        if changed:
            actions[step][:, 0] = (actions[step][:, 0] + 9) % 16
        shown.append(torch.stack(play(env, actions)[1::2]))
    one, other = (steps[:, :, 1:] for steps in (td["agents"] for td in shown))
    for key in (OBSERVATION[1], ACTION_MASK[1], FRAME[1]):
        # Executed in the step that begins two later, and told a step after that has ended.
        assert one[key][: step + 3].equal(other[key][: step + 3]), key
    frames = [td[FRAME][step, :, 0] for td in shown]
    assert not frames[0].equal(frames[1])


def test_an_agent_is_not_ready_while_a_command_that_takes_time_is_under_way():
    late = DelayConfig(act="1..3", act_hold="max")
    env = make_env(everything("polynomial", delay=late, actions=ABSOLUTE, episode=LONG), 2)
    td = env.reset()
    flown = env.uav_env.state.goal
    for t in range(4):
        assert td["agents", "ready"].all() == (t == 0)
        assert env.uav_env.state.goal.equal(flown)
        mask = td[ACTION_MASK].float()
        assert (mask.sum(-1) == 1).all() == (t > 0)
        action = mask.flip(-1).argmax(-1)  # the last legal one that lies 200 m away
        td = env.step(td.set(ACTION, mask.shape[-1] - 1 - action))["next"]
    assert not env.uav_env.state.goal.equal(flown)


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"links": LinkConfig("updown")}, "links"),
        ({"clock": ClockConfig(server="2s")}, "clock.server"),
        ({"actions": ActionConfig(distances=[50.0], command="absolute")}, "distances"),
    ],
)
def test_what_does_not_go_with_absolute_commands_is_refused_in_one_line(changed, named):
    with pytest.raises(InputError, match=rf"^actions.command: [^\n]*{named}[^\n]*$"):
        square(**({"actions": ABSOLUTE} | changed))


@pytest.mark.parametrize(
    "observation", [ObservationConfig(intent=True), ObservationConfig(["place", "pending"])]
)
def test_what_tells_of_commands_needs_some_that_are_under_way(observation):
    for late in ({}, {"actions": ABSOLUTE}, {"delay": DelayConfig(act=2)}):
        with pytest.raises(InputError, match=r"^observation[^\n]* needs actions.command[^\n]*$"):
            square(**late, observation=observation)


@pytest.mark.parametrize("own", [True, False])
def test_agents_see_their_latest_commands_and_which_are_known_to_be_executed(own):
    delay = DelayConfig(obs=2, act="1..3", act_loss=0.3)
    observation = ObservationConfig(["place", "pending"], own=own, stops=8)
    common = {"region": WIDE, "delay": delay, "observation": observation, "episode": LONG}
    env = make_env(square(agents=2, **common, actions=ABSOLUTE), 3, extras=["message"])
    points = env.uav_env.simulation.points
    half = env.uav_env.simulation.airspace.scale[0] / 2
    generator = torch.Generator().manual_seed(4)
    td = env.reset()
    frames = [td[FRAME]]
    fates = set()
    for now in range(1, 20):
        td = env.step(td.set(ACTION, random_actions(env.uav_env, generator)))["next"]
        frames.append(td[FRAME])
        read = {OBSERVATION: "message" if own else "received", GLOBAL_OBSERVATION: "received"}
        shown = {key: env.layout[key[-1]]["pending"].of(td[key]) for key in OBSERVED}
        remembered = shown[OBSERVATION].shape[-2]
        assert remembered == (3 if own else 5)
        for k in range(min(now, remembered)):
            number = now - k  # of the command after which an agent's frame was this
            way = ((points[frames[number]] - points[td[FRAME]]) / half).clamp(-1, 1)
            for key, value in shown.items():
                east_north, age, known, exists = value[..., k, :].split([2, 1, 1, 1], -1)
                assert east_north.allclose(way, atol=1e-5)
                assert age.allclose(torch.tensor((k + 1) / remembered))
                assert exists.all()
                messages = env.uav_env.server.messages(td["agents", read[key]])
                assert known.bool().equal(messages.executed >= number)
                fates.update(known.flatten().tolist())
        assert not any(value[..., now:, :].any() for value in shown.values())
    assert fates == {0.0, 1.0}


@pytest.mark.parametrize(
    ("obs", "act"),
    [
        (0, 2),
        (2, 3),
        (3, 2),
    ],
)
def test_others_tell_where_their_commands_under_way_lead_and_by_when(obs, act):
    delay = DelayConfig(obs=obs, act="0..2" if act == 2 else act, act_hold="max")
    observation = ObservationConfig(["place"], own=True, stops=5, intent=True)
    common = {"region": WIDE, "delay": delay, "observation": observation, "episode": LONG}
    env = make_env(square(agents=2, **common, actions=ABSOLUTE), 3)
    points = env.uav_env.simulation.points
    half = env.uav_env.simulation.airspace.scale[0] / 2
    (announced,) = (each for each in env.layout["observation"] if each.name == "announced")
    generator = torch.Generator().manual_seed(4)
    td = env.reset()
    frames = [td[FRAME]]
    for now in range(1, 15):
        td = env.step(td.set(ACTION, random_actions(env.uav_env, generator)))["next"]
        frames.append(td[FRAME])
        told = now - obs  # when the newest message was sent that has arrived
        nearest = announced.of(td[OBSERVATION])[:, :, 0]
        for k, (east, north, until, exists) in enumerate(
            nearest.unbind(-2)[i].unbind(-1) for i in range(act)
        ):
            sent = told - k  # the command after which an agent's frame was this
            assert (exists == (sent > 0)).all()
            if sent > 0:
                assert until.allclose(torch.tensor(min((sent + act - now) / act, 1.0)).clamp(-1))
                led = points[frames[sent]].flip(1)
                way = ((led - points[td[FRAME]]) / half).clamp(-1, 1)
                assert torch.stack([east, north], -1).allclose(way, atol=1e-5)
    assert not announced.of(td[OBSERVATION])[:, :, 1:].any()
