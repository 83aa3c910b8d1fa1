"""As ``server/test_golden_rewards.py``: moves, detections, geometry."""

import json
import math
from collections import Counter

import pytest
import shapely
import torch
from golden_records import (
    CUMULATIVE,
    EPISODES,
    PERSISTENT,
    TOLERANCE,
    column,
    ready_env,
    recorded,
    set_state,
    settings_points,
)
from helpers import DATA, GOLDEN, act, nearest, sent_messages, usecase

from damian import UavEnv
from damian.world.config import MotionConfig
from damian.world.landing import action_table


def reason_for_other_point(case, transition, uav):
    """Why this project leads the UAV to another point than the original; None if it does not."""
    golden = GOLDEN[case]
    points = golden["scenario"]["landing_points"]
    polygon = shapely.Polygon(golden["scenario"]["polygon_vertices_ring"])
    row = golden["action_table"][transition.after["actions"][uav]]
    here = transition.places[uav]
    there = transition.after["positions"]
    target = [here[0] + row["dx"], here[1] + row["dy"]]
    if not shapely.contains_xy(polygon, *target):
        target = here
    if nearest(points, target) == nearest(points, here):
        return "the UAV may hold"
    if there[uav] in there[:uav]:
        return "another UAV has booked its point"
    return None


@pytest.mark.parametrize(
    ("case", "compared", "reasons"),
    [
        (1, 65, {"the UAV may hold": 103}),
        (2, 288, {"the UAV may hold": 271, "another UAV has booked its point": 5}),
    ],
)
def test_recorded_actions_lead_to_the_recorded_points(case, compared, reasons):
    records = recorded(case, EPISODES, PERSISTENT, CUMULATIVE)
    env = ready_env(usecase(case), len(records))
    set_state(env, records, [transition.places for transition in records])
    after = sent_messages(act(env, column(records, "actions")))
    position = after.position + env.simulation.airspace.offset[0]
    counts = Counter()
    for world, transition in enumerate(records):
        for uav, place in enumerate(transition.after["positions"]):
            reason = reason_for_other_point(case, transition, uav)
            counts[reason] += 1
            if reason is None:
                ours = position[world, uav].tolist()
                assert ours == pytest.approx(place, abs=TOLERANCE), (transition, uav)
    assert counts.pop(None) == compared
    assert counts == reasons


@pytest.mark.parametrize(
    ("case", "n_flags", "after_detection"),
    [
        (1, 168, 24),
        (2, 564, 181),
    ],
)
def test_recorded_points_give_the_recorded_detections_and_numbers_of_motions(
    case, n_flags, after_detection
):
    records = recorded(case, EPISODES, PERSISTENT, CUMULATIVE)
    env = ready_env(usecase(case), len(records))
    set_state(env, records, [transition.after["positions"] for transition in records])
    spotted = sent_messages(act(env, torch.zeros(len(records), env.n_agents).long())).spotted
    theirs = column(records, "spotting_true").bool()
    assert spotted.equal(theirs)
    assert theirs.numel() == n_flags
    motions = env.state.motions
    expected = column(records, "motions_counter_after")
    # In the original the counter of a UAV stays at 0 for some steps after a detection.
    side_effect = ~theirs & (expected == 0)
    assert int(side_effect.sum()) == after_detection
    assert motions[~side_effect].equal(expected[~side_effect])
    assert (motions[side_effect] > 0).all()


@pytest.mark.parametrize("case", [1, 2])
def test_the_recorded_geometry_and_action_table_are_reproduced(case):
    golden = GOLDEN[case]["scenario"]
    env = UavEnv(usecase(case))
    simulation = env.simulation
    airspace = env.simulation.airspace
    assert airspace.n_points.tolist() == [golden["n_landing_points"]] == [92]
    ours = settings_points(env)
    distance = torch.cdist(ours, torch.tensor(golden["landing_points"], dtype=torch.float64))
    assert distance.amin(0).max() < TOLERANCE
    assert distance.amin(1).max() < TOLERANCE
    assert simulation.radius == pytest.approx(golden["footprint_radius_m"], abs=TOLERANCE)
    assert airspace.scale.item() == pytest.approx(golden["max_distance_normaliser_m"], abs=1e-4)
    table = action_table(usecase(case).actions)
    for ours, row in zip(table.tolist(), GOLDEN[case]["action_table"], strict=True):
        assert ours[0] == row["distance_m"]
        assert math.remainder(ours[1] - row["heading_rad"], 2 * math.pi) == pytest.approx(
            0, abs=1e-6
        )


def test_recorded_flights_have_the_same_ends_and_durations():
    run = json.loads((DATA / "motion_energy_coverage.json").read_text())[
        "action_delay_env_run_usecase1_FL2"
    ]
    flights = [row for row in run if row["counters"] == [1.0, 0.0, 0.0]]
    assert len(flights) == 4
    motion = MotionConfig("polynomial", max_speed=5.0, max_acceleration=2.0, min_level=2.0)
    env = ready_env(usecase(1, motion=motion), 1)
    points = settings_points(env)
    for row in flights:
        assert env.simulation.vehicles.ready(env.state).all()
        act(env, torch.tensor([[row["action"]]]))
        state = env.state
        assert points[state.origin].squeeze().tolist() == pytest.approx(row["start"], abs=1e-4)
        assert points[state.goal].squeeze().tolist() == pytest.approx(row["target"], abs=1e-4)
        times = [state.vertical.item(), state.cruise.item(), state.vertical.item()]
        assert times == pytest.approx(row["T"], abs=TOLERANCE)
        for _ in range(math.ceil(sum(times)) - 1):
            act(env, torch.tensor([[row["action"]]]))
