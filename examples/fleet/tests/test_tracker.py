"""The server node that follows UAVs by their reports knows what the simulation's one does, and no
more."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from reports import LLANBEDR, START, Reporter, names_of, read_json
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian import keys
from damian.baselines.script import script_policy
from damian.common.errors import InputError
from damian.delays.config import DelayConfig
from damian.envs.config import ClockConfig, ScenarioConfig
from damian.envs.pipeline import make_env
from damian.learners.config import MappoConfig
from damian.models.config import MlpConfig
from damian.models.memory import add_recurrent_state
from damian.server.config import EpisodeConfig, ObservationConfig
from damian.world.config import MotionConfig, RegionConfig, SourceConfig
from damian_fleet.advice import next_landings
from damian_fleet.node import Node
from damian_fleet.reports import Report
from damian_fleet.tracker import Tracker

LATE = {"law": "uniform", "low": 0, "high": 4}
WALK = SourceConfig(motion="dynamic", level_db=143.0, emission="per_step", emission_probability=0.6)
FEATURES = [
    "source_distance",
    "source_bearing",
    "source_time",
    "source_drift",
    "agent_distances",
    "coverage",
]
SEEN = ObservationConfig(global_features=FEATURES, local_features=["spotted", "battery"], age=True)
BELIEF = replace(SEEN, belief=["belief_gain", "belief_moments"])
TASKS: dict[str, dict[str, Any]] = {
    "on time": {"observation": SEEN},
    "late": {"delay": DelayConfig(obs=LATE, loss=0.2), "observation": SEEN},
    "the last to arrive": {
        "delay": DelayConfig(obs=LATE, loss=0.2, order="arrival"),
        "observation": SEEN,
    },
    "held back": {"delay": DelayConfig(obs=LATE, hold="max"), "observation": SEEN},
    "messages": {"delay": DelayConfig(obs=LATE, loss=0.2, messages=5), "observation": SEEN},
    "belief": {"delay": DelayConfig(obs=LATE, loss=0.2), "observation": BELIEF},
    "clocks": {
        "delay": DelayConfig(obs=LATE),
        "observation": SEEN,
        "clock": ClockConfig(agents="2s", server="4s"),
    },
    "flights": {  # no loss: a report in flight counts where the UAV reported last on the ground
        "delay": DelayConfig(obs=2),
        "observation": BELIEF,
        "motion": MotionConfig(
            kind="polynomial", max_speed=40.0, max_acceleration=20.0, sensing_time=2.0
        ),
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


def scenario_of(**changed) -> ScenarioConfig:
    endless = {"episode": EpisodeConfig(max_steps=None), "region": LLANBEDR, "source": WALK}
    return ScenarioConfig(**{**endless, "agents": 3, **changed})


def recurrent(env):
    """A policy with random weights and hidden states, the same for every environment of a
    scenario."""
    torch.manual_seed(7)
    actor = MappoConfig().make_actor(env, MlpConfig(hidden=[16], rnn="gru"))
    add_recurrent_state(env, actor)
    return actor


OTHERS = ["on time", "the last to arrive", "messages", "clocks", "a region of metres"]


@pytest.mark.parametrize(
    ("task", "fraction"),
    [
        *((task, 0.0) for task in TASKS if task not in OTHERS),
        *(pytest.param(task, 0.0, marks=pytest.mark.slow) for task in OTHERS),
        ("late", 0.7),
        pytest.param("flights", 0.7, marks=pytest.mark.slow),
    ],
)
def test_it_observes_what_the_simulation_does_bit_for_bit(task, fraction):
    scenario = scenario_of(**TASKS[task])
    env = make_env(scenario, 1, 3, extras=["message"])
    node = Node(scenario, 3)
    policy = script_policy(env)
    n_spotted = 0
    rows = []
    seen = [env.reset()]
    reporter = Reporter(env, node.ground, fraction)
    reporter.send(seen[0], 0, at_once=True)
    for step in range(90 if task == "flights" else 40):
        now = reporter.time_of(step) + 0.2 * reporter.dt
        came = reporter.arriving(step)
        rows += [(where, report) for where, report in (read_json(came) if came else [])]
        for _, report in rows[len(rows) - len(came) :]:
            report.stamp(now)
        seen.append(env.step(policy(seen[-1].clone()))["next"])
        reporter.send(seen[-1], step + 1)
    tracker = Tracker(node, names_of(3), rows)
    for step, (read, shown) in enumerate(zip(tracker.steps(now), seen, strict=False)):
        for key in (keys.OBSERVATION, keys.TIMELINE, keys.BELIEF):
            if key in shown.keys(True):
                assert torch.equal(read[key], shown[key]), (step, key)
        assert torch.equal(read[keys.RECEIVED], shown.get(keys.RECEIVED, shown[keys.MESSAGE])), step
        n_spotted += sum(held.spotted for held in tracker.held.values())
    assert step == len(seen) - 2
    assert n_spotted > 0


@pytest.mark.parametrize("policy_of", [script_policy, recurrent])
def test_a_table_is_answered_as_the_policy_acts_in_the_simulation(policy_of):
    scenario = scenario_of(observation=BELIEF)
    env = make_env(scenario, 1, 3, extras=["message"])
    node = Node(scenario, 3)
    policy = policy_of(env)
    rows = []
    n_moved = 0
    reporter = Reporter(env, node.ground)
    shown = env.reset()
    reporter.send(shown, 0, at_once=True)
    for step in range(12):
        rows += [
            {**row, "receive time": row["time"] + 0.2} for row in reporter.arriving(step)[::-1]
        ]
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            shown = policy(shown)
        answers = next_landings(read_json(rows), node, policy_of(node.env), START)
        goals = env.uav_env.simulation.decide(env.uav_env.state, shown[keys.ACTION], None).goal[0]
        assert [*zip(answers.lat, answers.lon, strict=True)] == [
            *map(node.ground.place, goals.tolist())
        ]
        n_moved += (answers.state == "fly").sum()
        shown = env.step(shown)["next"]
        reporter.send(shown, step + 1)
    assert n_moved > 0


def test_who_is_in_flight_is_not_advised():
    node = Node(scenario_of(observation=SEEN), 3)
    rows = [{"ID": uav, "AoI": 1} for uav in "abc"]
    for row, point in zip(rows, (200, 300, 400), strict=True):
        row["lat"], row["lon"] = node.ground.place(point)
    rows[1]["FLA"] = 20
    answers = next_landings(read_json(rows), node, script_policy(node.env), START)
    assert [*(answers.state == "in flight")] == [*answers.lat.isna()] == [False, True, False]
    assert {*answers.age} == {1.0}


def told(
    uav: str, time: float, point: int, received: float | None = None, **more
) -> dict[str, Any]:
    """A report of a UAV at a landing point, which comes in a tenth of a second later."""
    came = time + 0.1 if received is None else received
    return {"uav": uav, "time": time, "point": point, "receive_time": came, **more}


FIRST = [told(uav, START, 200 + i) for i, uav in enumerate("abc")]


def followed(*reports: dict[str, Any], until: float, **changed) -> Tracker:
    """What the server node knows at an instant [s] from the first reports of three UAVs and
    these."""
    node = Node(scenario_of(**changed), 3)
    rows = []
    for said in [*FIRST, *reports]:
        lat, lon = node.ground.place(said["point"])
        more = {name: value for name, value in said.items() if name not in ("uav", "point")}
        rows.append(("", Report(**more, id=said["uav"], lat=lat, lon=lon)))
    tracker = Tracker(node, ["a", "b", "c"], rows)
    for _ in tracker.steps(until):
        pass
    return tracker


def test_a_scenario_that_holds_messages_holds_reports_until_its_longest_delay():
    for second, point in ((6, 200), (7, 7)):
        tracker = followed(told("a", START + 3, 7), until=START + second, **TASKS["held back"])
        assert tracker.held["a"].point == point


def test_a_late_detection_is_known_to_newer_messages_that_say_nothing_of_it():
    reports = [
        told("a", START + 5, 210),
        told("a", START + 3, 205, START + 6, source_spotted=True),
        told("a", START + 3, 205, START + 6.1, source_spotted=True),  # it is known already
        told("a", START - 3, 100, START + 6),  # before the start
    ]
    tracker = followed(*reports, until=START + 7)
    held = tracker.held["a"]
    log = tracker.logs["a"].reports
    assert (held.point, held.detected, held.detected_at, len(log)) == (210, 3, 205, 3)


def test_two_reports_of_one_instant_count_and_tell_of_the_landing_before():
    second = told("a", START + 5, 210, START + 5.2, source_spotted=True, landed=START + 4)
    held = followed(told("a", START + 5, 210), second, until=START + 7).held["a"]
    assert (held.detected, held.stops[:2]) == (5, ((210, 4), (200, 0)))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"uav": "d"}, "ID: 'd' is not a UAV of this fleet: a, b, c"),
        ({"time": START + 60}, "time: 1700000060 s is 59.9 s after it came in"),
        ({"time": 5.0}, "time: 5 s is 1.7e+09 s before it came in: the clock of a is not set"),
        ({"source_lat": 52.8}, "places are pairs lat, lon [deg], or all of them x, y [m]"),
        ({"readings": (1.0,)}, "readings: 1 numbers are not 0, as in the training"),
        (
            {"time": START + 2e6, "receive_time": START + 2e6},
            "time: the first reports are more than 1e+06 s",
        ),
    ],
)
def test_what_no_uav_can_say_is_refused(changed, message):
    with pytest.raises(InputError) as error:
        followed(told("a", START, 3) | changed, until=START)
    assert message in str(error.value)


def test_a_report_numbered_after_one_that_was_generated_later_is_refused():
    tracker = followed(told("a", START + 30, 210, sequence=7), until=START + 31)
    late, back = (
        Report(id="a", time=START + 10, sequence=n, lat=52.811, lon=-4.129, receive_time=START + 31)
        for n in (6, 8)
    )
    tracker.check(late)
    with pytest.raises(
        InputError, match=r"s is 20\.0 s before that of number 7: the clock of a was set back"
    ):
        tracker.check(back)
