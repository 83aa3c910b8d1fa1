"""A journal tells what happened: the flight as a simulation recorded it, but for the source."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from reports import LLANBEDR, Reporter, names_of, write_journal

from damian.baselines.script import script_policy
from damian.common.errors import InputError
from damian.delays.config import DelayConfig
from damian.envs.config import ScenarioConfig
from damian.envs.pipeline import make_env
from damian.envs.uav_env import EXTRAS
from damian.server.config import EpisodeConfig, ObservationConfig
from damian.show.episode import Episode, record
from damian.world.config import BatteryConfig, MotionConfig, SourceConfig
from damian_fleet.node import Node, for_uavs
from damian_fleet.playback import episodes_of

N_STEPS = 60
SCENARIO = ScenarioConfig(
    agents=3,
    region=LLANBEDR,
    source=SourceConfig(
        motion="dynamic", level_db=143.0, emission="per_step", emission_probability=0.6
    ),
    delay=DelayConfig(obs={"law": "uniform", "low": 0, "high": 4}, loss=0.2),
    observation=ObservationConfig(local_features=["spotted", "battery"], belief=["belief_moments"]),
    battery=BatteryConfig(enabled=True),
    episode=EpisodeConfig(max_steps=None),
)
MOTIONS = {
    "instant": MotionConfig(),
    "flights": MotionConfig(
        kind="polynomial", max_speed=40.0, max_acceleration=20.0, sensing_time=2.0
    ),
}
SCENARIOS = {name: replace(SCENARIO, motion=motion) for name, motion in MOTIONS.items()}


def played(path, scenario: ScenarioConfig) -> list[Episode]:
    @cache
    def node_of(n: int) -> Node:
        return Node(for_uavs(scenario, n), 3, reward_terms=True)

    return episodes_of(path, node_of, {})


@pytest.fixture(scope="module", params=[pytest.param("instant", marks=pytest.mark.slow), "flights"])
def scenario(request) -> ScenarioConfig:
    return SCENARIOS[request.param]


@pytest.fixture(scope="module")
def flown(tmp_path_factory, scenario) -> tuple:
    """A simulated flight, the episode that the simulation recorded, and the journal of its
    reports."""
    env = make_env(scenario, 1, 3, extras=EXTRAS)
    rollout = env.rollout(N_STEPS, script_policy(env), break_when_any_done=False)
    reporter = Reporter(env, Node(scenario, 3).ground)
    lines = []
    for step in range(N_STEPS + 1):
        reporter.send(
            rollout[:, step] if step < N_STEPS else rollout[:, -1]["next"], step, at_once=step == 0
        )
        now = reporter.time_of(step) + 0.2 * reporter.dt
        lines += [{"received": now, "reports": rows}] if (rows := reporter.arriving(step)) else []
        lines.append({"asked": now + 0.1 * reporter.dt, "told": {}})
    path = tmp_path_factory.mktemp("journals") / "north.jsonl"
    return record(rollout, env.uav_env, {})[0], write_journal(path, *lines, uavs=names_of(3))


@pytest.fixture(scope="module")
def told(flown, scenario) -> Episode:
    return played(flown[1], scenario)[0]


def test_a_journal_tells_what_the_server_knew_bit_for_bit(flown, told):
    recorded = flown[0]
    assert np.array_equal(told.time, recorded.time)
    for name in ("believed", "age", "belief", "cells", "landing_points"):
        assert np.array_equal(getattr(told, name), getattr(recorded, name)), name
    np.testing.assert_allclose(told.reward, recorded.reward, atol=1e-6)
    for name, term in recorded.reward_terms.items():
        np.testing.assert_allclose(told.reward_terms[name], term, atol=1e-6)
    assert (told.source, told.emits, told.names) == (None, None, names_of(3))
    assert told.about["began"] == "2023-11-14T22:13:20.000Z"
    assert told.reward[1:].any()
    assert (told.age > 0).any()


def test_a_journal_tells_what_was_sent_and_when_it_arrived_unless_the_flight_ended_before(
    flown, told
):
    recorded = flown[0]
    arrived = recorded.sent & (recorded.delay >= 0)
    arrived &= np.arange(N_STEPS + 1)[:, None] + recorded.delay <= N_STEPS
    assert np.array_equal(told.sent & (told.delay >= 0), arrived)
    assert np.array_equal(told.delay[arrived], recorded.delay[arrived])
    missing = recorded.sent & ~arrived
    for uav in range(
        3
    ):  # losses are seen by gaps between numbers, up to the last message that came in
        last = np.flatnonzero(arrived[:, uav])[-1]
        assert told.lost[:, uav].sum() == missing[:last, uav].sum()
    if recorded.instant:  # messages of every step: it is also known when they were sent
        assert not (told.lost & ~missing).any()
    assert told.lost.any()


def test_where_uavs_were_is_what_they_reported_in_hindsight(flown, told):
    recorded = flown[0]
    came = told.sent & (told.delay >= 0)
    came[0] = True
    # A message at takeoff names the landing point, which the UAV has just left.
    np.testing.assert_allclose(told.true[came], recorded.true[came], atol=1.0)
    np.testing.assert_allclose(told.battery[came], recorded.battery[came], atol=1e-4)
    assert np.array_equal(told.spotted[came], recorded.spotted[came])
    np.testing.assert_allclose(told.target[came], recorded.target[came], atol=0.01)
    turn = (told.track[came] - recorded.track[came] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turn, 0, atol=1e-4)
    assert told.spotted.any()
    steps = np.arange(N_STEPS + 1)
    for uav in range(3):  # in between, they flew straight
        for axis in range(2):
            straight = np.interp(steps, steps[came[:, uav]], recorded.true[came[:, uav], uav, axis])
            np.testing.assert_allclose(told.true[:, uav, axis], straight, atol=1.0)


def test_a_journal_without_a_flight_is_refused(tmp_path):
    path = write_journal(tmp_path / "x.jsonl", uavs=names_of(1))
    with pytest.raises(
        InputError, match=r"x\.jsonl: the fleet never began: not every UAV has reported"
    ):
        played(path, SCENARIO)


def test_another_episode_begins_when_uavs_join_and_leave(tmp_path):
    ground = Node(SCENARIO, 3).ground

    def reports(now: float, *uavs: int) -> dict:
        rows = [{"ID": names_of(4)[i], "time": now - 0.5} for i in uavs]
        for row, i in zip(rows, uavs, strict=True):
            row["lat"], row["lon"] = ground.place(100 * i)
        return {"received": now, "reports": rows}

    first, *others, last = names_of(4)
    members = {"join": [last], "leave": [first], "received": 1005.0}
    lines = [reports(1000.0, 0, 1, 2), members, reports(1007.0, 1, 3), reports(1009.0, 2)]
    path = write_journal(
        tmp_path / "x.jsonl", *lines, {"asked": 1012.0, "told": {}}, uavs=names_of(3)
    )
    before, after = played(path, replace(SCENARIO, observation=ObservationConfig()))
    assert (before.names, after.names) == ([first, *others], [*others, last])
    assert (before.n_steps, after.n_steps) == (0, 3)
    assert after.age[-1].tolist() == [5.0, 3.0, 5.0]
    assert np.array_equal(after.believed[-1, 2], ground.points[300].astype(np.float32))


def test_reports_of_a_wrong_clock_are_left_out_of_the_flight_and_named(tmp_path, capsys):
    ground = Node(SCENARIO, 3).ground
    lines = []
    for second in range(40):
        for uav in names_of(3):
            sets_back = 30.0 if uav == "uav-1" and second >= 15 else 0.0
            row = {"ID": uav, "time": 1000.0 + second - sets_back, "sequence": second}
            row["lat"], row["lon"] = ground.place(100 + second)
            lines.append({"received": 1000.2 + second, "reports": [row]})
    path = write_journal(tmp_path / "x.jsonl", *lines, uavs=names_of(3))
    (episode,) = played(path, replace(SCENARIO, observation=ObservationConfig()))
    assert capsys.readouterr().out.splitlines() == [
        f"note: {path}: line 48: the clock of uav-1 is 30 s behind in 25 messages from here on: "
        "they are left out"
    ]
    assert not episode.lost.any()
    assert episode.sent.sum(0).tolist() == [39, 14, 39]
    assert episode.age[-1].tolist() == [0.0, 25.0, 0.0]
