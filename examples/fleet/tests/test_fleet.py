"""The server node outside the simulation observes what the one inside does, from what the UAVs report."""

from dataclasses import replace

import pytest
import torch
from reporting import FREE, START, advise, flights

from damian import keys
from damian.baselines.script import script_policy
from damian.common.errors import InputError
from damian.delays.config import DelayConfig
from damian.envs.config import ClockConfig, ScenarioConfig
from damian.field.node import Node
from damian.field.rows import Report
from damian.server.config import EpisodeConfig, ObservationConfig
from damian.world.config import ActionConfig, MotionConfig, RegionConfig, SourceConfig
from damian_fleet.fleet import Fleet, Waiting
from damian_fleet.idle import settles
from damian_fleet.orders import GRACE

LLANBEDR = RegionConfig(kind="fir", path="damian:fir.csv", id="LlanbedrTest", initial_conditions=1)
"""With a single initial condition, whose table of first observations rounds as that of a single fleet."""
LATE = {"law": "uniform", "low": 0, "high": 4}
BELIEF = ["belief_gain", "belief_moments"]
WALK = SourceConfig(motion="dynamic", level_db=143.0, emission="per_step", emission_probability=0.6)


def scenario_of(**changed) -> ScenarioConfig:
    endless = {"episode": EpisodeConfig(max_steps=None), "region": LLANBEDR, "source": WALK}
    return ScenarioConfig(**{**endless, "agents": 3, **changed})


FEATURES = ["source_distance", "source_bearing", "source_time", "source_drift", "agent_distances", "coverage"]
SEEN = ObservationConfig(global_features=FEATURES, local_features=["spotted", "battery"], age=True)
TASKS = {
    "on time": {"observation": SEEN},
    "late": {"delay": DelayConfig(obs=LATE, loss=0.2), "observation": SEEN},
    "the last to arrive": {"delay": DelayConfig(obs=LATE, loss=0.2, order="arrival"), "observation": SEEN},
    "held back": {"delay": DelayConfig(obs=LATE, hold="max"), "observation": SEEN},
    "history": {"delay": DelayConfig(obs=LATE, loss=0.2, history=3, messages=5), "observation": SEEN},
    "belief": {"delay": DelayConfig(obs=LATE, loss=0.2), "observation": replace(SEEN, belief=BELIEF)},
    "clocks": {
        "delay": DelayConfig(obs=LATE, history=2),
        "observation": SEEN,
        "clock": ClockConfig(agents="2s", server="4s"),
    },
    "flights": {
        "delay": DelayConfig(obs=LATE, loss=0.2, history=2),
        "observation": replace(SEEN, belief=BELIEF),
        "motion": MotionConfig(kind="polynomial", max_speed=20.0, max_acceleration=10.0, sensing_time=2.0),
    },
    "continuous": {
        "delay": DelayConfig(obs=LATE, loss=0.2),
        "observation": SEEN,
        "actions": ActionConfig(kind="continuous"),
    },
    "timeline": {
        "delay": DelayConfig(obs=LATE),
        "motion": MotionConfig(kind="polynomial", max_speed=20.0, max_acceleration=10.0),
        "observation": ObservationConfig(["place"], ["others"], timeline=6),
    },
    "a region of metres": {
        "delay": DelayConfig(obs=LATE),
        "observation": SEEN,
        "region": RegionConfig(initial_conditions=1),
    },
}


@pytest.mark.parametrize(
    ("task", "fraction"), [*((task, 0.0) for task in TASKS), ("late", 0.7), ("flights", 0.7)]
)
def test_a_fleet_observes_and_advises_what_the_simulation_does_bit_for_bit(task, fraction):
    scenario = scenario_of(**TASKS[task])
    spotted, moved, n_steps = 0, 0, 90 if task == "flights" else 40
    for shown, fleet, action, ready, step in flights(scenario, script_policy, n_steps, fraction=fraction):
        read = fleet.observe(ready)
        for key in (keys.OBSERVATION, keys.ACTION_MASK, keys.TIMELINE):
            if key in shown.keys(True):
                assert torch.equal(read[key], shown[key]), (step, key)
        held = shown.get(keys.RECEIVED, shown[keys.MESSAGE])
        assert torch.equal(read[keys.RECEIVED], held), step
        chosen = advise(fleet, fleet.clock, [fleet.uavs[uav] for uav in ready])
        assert chosen == ready
        assert torch.equal(fleet.action[0, ready], action[0, ready])
        spotted += sum(held.spotted for held in fleet.held)
        assert all(here.report.time <= fleet.clock for here in fleet.held)
        moved += sum(fleet.decision(uav).origin != fleet.decision(uav).goal for uav in ready)
    assert moved > 3
    assert spotted > 0


SILENT = 40


def fleet_of(**changed) -> Fleet:
    node = Node(scenario_of(**changed), 3)
    return Fleet(node, ["a", "b", "c"], script_policy(node.env), rules=FREE)


def report_of(
    fleet: Fleet, uav: str, time: float, point: int, received: float | None = None, **more
) -> Report:
    lat, lon = fleet.ground.place(point)
    report = Report(**{"id": uav, "time": time, "lat": lat, "lon": lon, **more})
    report.stamp(time + 0.1 if received is None else received)
    return report


def told(fleet: Fleet, *given, **more) -> str:
    report = report_of(fleet, *given, **more)
    fleet.check(report)
    return fleet.report(report)


def begun(distance: int = 30, time: float = START, **changed) -> Fleet:
    """A fleet that has begun, whose UAVs stand so many landing points apart."""
    fleet = fleet_of(**changed)
    for i, uav in enumerate(fleet.uavs):
        told(fleet, uav, time, 200 + distance * i)
    return fleet


@pytest.mark.parametrize("task", ["belief", "clocks", "late", "held back", "history", "the last to arrive"])
def test_after_a_long_silence_it_does_not_matter_when_somebody_asked(task, monkeypatch):
    """One fleet takes every step when it comes, another one many at once, or skips those of silence."""
    monkeypatch.setattr("damian_fleet.fleet.SILENT_STEPS", SILENT)
    fleets = [begun(**TASKS[task]) for _ in range(2)]
    if task != "belief":
        never = fleets[0].node  # it skips no step
        settled = "damian_fleet.fleet.settles"
        monkeypatch.setattr(settled, lambda node: 10**9 if node is never else settles(node))
    for fleet in fleets:
        told(fleet, "b", START + 4, 30, START + 5.5, source_spotted=True)
        advise(fleet, START + 6, ["c"])
        told(fleet, "c", START + 8, 70)
    for step in range(9, 3 * SILENT, 7):
        fleets[0].advance(START + step)
    for fleet in fleets:
        told(fleet, "a", START + 3 * SILENT + 5.5, 17, source_spotted=True)
        fleet.advance(START + 3 * SILENT + 9)
    one, other = (fleet.observe([0, 1, 2]) for fleet in fleets)
    for key in (keys.OBSERVATION, keys.RECEIVED, keys.TIMELINE):
        assert key not in one.keys(True) or torch.equal(one[key], other[key])
    assert fleets[0].step == fleets[1].step == 3 * SILENT + 9


def test_a_landing_point_that_somebody_was_sent_to_is_not_given_away():
    """The UAV does not report any more; after a while it is believed where it was last."""
    fleet = begun(1, actions=ActionConfig(distances=[0.0, 60.0], headings=[0.0, 90.0, 180.0, 270.0]))
    advise(fleet, START + 1, ["a"])
    decision = fleet.decision(0)
    assert decision.goal != decision.origin
    told(fleet, "a", START + 3, decision.origin)
    for second in (4.0, decision.duration, 2 * decision.duration + GRACE - 1):
        fleet.advance(START + second)
        assert fleet._standing(0, asks=False) == decision.goal
        assert fleet._standing(0, asks=True) == decision.origin
    fleet.advance(START + 2 * decision.duration + GRACE + 2)
    assert fleet._standing(0, asks=False) == decision.origin


def test_a_uav_in_flight_is_not_asked_and_took_off_from_where_it_was_sent():
    fleet = begun(1)
    advise(fleet, START + 1)
    decision = fleet.decision(0)
    told(fleet, "a", START + 2, 300, fla=5.0, source_spotted=True)
    assert advise(fleet, START + 3) == [1, 2]
    held = fleet.held[0]
    assert (held.point, held.target, held.spotted) == (decision.origin, decision.goal, False)


def test_a_late_detection_is_known_to_newer_messages_that_say_nothing_of_it():
    fleet = begun(1)
    assert told(fleet, "a", START + 5, 210) == "new"
    assert told(fleet, "a", START + 3, 205, START + 6, source_spotted=True) == "late"
    assert told(fleet, "a", START + 3, 205, START + 6) == "duplicate"
    assert told(fleet, "a", START - 3, 205, START + 6) == "old"
    fleet.advance(START + 7)
    assert (fleet.held[0].point, fleet.held[0].detected, fleet.held[0].detected_at) == (210, 3, 205)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"uav": "d"}, "ID: 'd' is not a UAV of this fleet: a, b, c"),
        ({"time": START + 60}, "time: 1700000060 s is 60.0 s after it came in"),
        ({"readings": (1.0,)}, "readings: 1 numbers are not 0, as in the training"),
    ],
)
def test_what_no_uav_of_the_fleet_can_say_is_refused(changed, message):
    fleet = fleet_of()
    with pytest.raises(InputError) as error:
        fleet.check(report_of(fleet, point=3, received=START, **{"uav": "a", "time": START, **changed}))
    assert str(error.value).startswith(message)


def test_what_comes_in_late_fills_in_no_earlier_step_whenever_steps_are_taken():
    """A fleet that is restored from its journal takes its steps later than it did."""
    seen = []
    for steps_at_once in (True, False):
        fleet = begun(1, **TASKS["history"])
        told(fleet, "a", START + 5, 210, battery=80.0)
        if steps_at_once:
            fleet.advance(START + 6.5)
        told(fleet, "a", START + 3, 205, START + 6.6, battery=10.0)
        fleet.advance(START + 7)
        seen.append(fleet.observe([0])[keys.TIMELINE])
    assert torch.equal(*seen)


def test_a_fleet_waits_for_every_uav_and_lasts_for_a_while(monkeypatch):
    monkeypatch.setattr("damian_fleet.fleet.LIFE", 50)
    fleet = fleet_of()
    told(fleet, "b", START, 30)
    with pytest.raises(Waiting, match="no advice yet: no report of a, c has come in"):
        fleet.choose(START + 1)
    for uav, point in (("a", 0), ("c", 60)):
        told(fleet, uav, START, point)
    assert advise(fleet, START + 49) == [0, 1, 2]
    with pytest.raises(InputError, match="the fleet began more than 50 s ago"):
        told(fleet, "a", START + 51, 0)


@pytest.mark.parametrize("task", ["belief", "clocks"])
def test_fleets_that_share_a_node_do_not_see_each_other(task):
    """Beside another fleet, which began earlier elsewhere, a fleet observes what it does alone."""

    def flown(node: Node, beside: Fleet | None) -> list:
        fleet, seen = Fleet(node, ["a", "b", "c"], script_policy(node.env), rules=FREE), []
        for step in range(12):
            if beside:
                told(beside, "b", START + step, 90 - step, battery=50.0, source_spotted=step % 2 == 0)
                advise(beside, START + step + 0.5)
            for i, uav in enumerate(fleet.uavs):
                told(fleet, uav, START + step - i, 30 * i + step, START + step, source_spotted=step == 5)
            advise(fleet, START + step + 0.5)
            read = fleet.observe([0, 1, 2])
            seen += [
                read[key].tolist() for key in (keys.OBSERVATION, keys.TIMELINE) if key in read.keys(True)
            ]
        return [*seen, *map(list, fleet.told)]

    scenario = scenario_of(**TASKS[task])
    shared = Node(scenario, 3)
    beside = Fleet(shared, ["a", "b", "c"], script_policy(shared.env), rules=FREE)
    for i, uav in enumerate(beside.uavs):
        told(beside, uav, START - 20, 200 + i, source_spotted=True)
    advise(beside, START - 10)
    assert flown(Node(scenario, 3), None) == flown(shared, beside)
