"""The signal source: walks in many polygons, and positions by integrated speed profiles."""

import json
import math
from fractions import Fraction

import helpers
import numpy as np
import pytest
import shapely
import torch
from hypothesis import given, strategies as st

from damian.world.signal_source import SourceConfig, Walk, draw_walks, leg_profile, locate

GOLDEN = json.loads((helpers.DATA / "motion_energy_coverage.json").read_text())
USE_CASE = shapely.Polygon(helpers.GOLDEN[1]["scenario"]["polygon_vertices_ring"])
DYNAMIC = SourceConfig(motion="dynamic")


def dynamic_walks(polygon=USE_CASE, n=8, seed=0, **settings_):
    config = SourceConfig(**({"motion": "dynamic", "after_walk": "stop"} | settings_))
    return draw_walks(polygon, config, n, np.random.default_rng(seed))


def twin_duration(length, speed, acceleration):
    """Duration of a leg: two ramps and a constant speed between them, or two ramps that meet."""
    if length == 0:
        return 0.0
    ramp = speed**2 / (2 * acceleration)
    if 2 * ramp >= length:
        return 2 * math.sqrt(length / acceleration)
    return 2 * speed / acceleration + (length - 2 * ramp) / speed


def twin_covered(length, speed, acceleration, elapsed, n=4000):
    """Integrate the speed, the least of rising, largest and falling speed, by the midpoint rule."""
    duration = twin_duration(length, speed, acceleration)
    end = min(max(elapsed, 0.0), duration)
    t = (np.arange(n) + 0.5) * end / n
    profile = np.minimum(np.minimum(acceleration * t, acceleration * (duration - t)), speed)
    return profile.sum() * end / n


def twin_position(walk, w, time):
    """Position [m] and latest stop of walk w at a time, by a search over its stops."""
    stop, arrive, depart, speed, acceleration = (x[w].tolist() for x in walk[:5])
    n = sum(math.isfinite(a) for a in arrive)
    k = max(i for i in range(n) if arrive[i] <= time)
    if k == n - 1 or time <= depart[k]:
        return stop[k], k
    length = math.dist(stop[k], stop[k + 1])
    share = twin_covered(length, speed[k], acceleration[k], time - depart[k]) / length
    return [a + share * (b - a) for a, b in zip(stop[k], stop[k + 1], strict=True)], k


POLYGONS = {
    "use case": USE_CASE,
    "hole": shapely.box(-100, -100, 100, 100) - shapely.box(-60, -60, 60, 60),
    "concave": shapely.Polygon([(0, 0), (200, 0), (200, 20), (20, 20), (20, 200), (0, 200)]),
    "sliver": shapely.Polygon([(0, 0), (1000, 0), (1000, 1e-3)]),
    "two parts": shapely.MultiPolygon([shapely.box(0, 0, 50, 50), shapely.box(300, 0, 350, 50)]),
}


def recorded_legs():
    """Whether a leg of the original is the first of its run, its length [m] and its duration
    [s]."""
    for run in GOLDEN["source_motion_action_delay"]:
        places = [place[:2] for place in run["hotspot_walk"]]
        moving = [dict(zip(run["columns"], row, strict=True)) for row in run["rows"]]
        moving = [row for row in moving if row["cur_moving_time"] > 0]
        times = {places.index([row["target_x"], row["target_y"]]): row["bcb_T"] for row in moving}
        for k, time in times.items():
            yield k == 1, math.dist(places[k - 1], places[k]), time


def test_recorded_legs_take_the_same_time():
    # Left out are triangular legs, which the original times as if they reached their largest speed,
    # and legs for which it kept the time of the leg before. Lengths are between planned stops.
    compared = 0
    triangular = 0
    stale = 0
    before = math.nan
    local = DYNAMIC.local_speed, DYNAMIC.local_acceleration
    for first, length, theirs in recorded_legs():
        speed, acceleration = (DYNAMIC.speed, DYNAMIC.acceleration) if first else local
        values = (torch.tensor(x, dtype=torch.float64) for x in (length, speed, acceleration))
        if length < speed**2 / acceleration:
            assert theirs == pytest.approx(length / speed + speed / acceleration, abs=1e-6)
            triangular += 1
        elif theirs == before:
            stale += 1
        else:
            assert leg_profile(*values)[1].item() == pytest.approx(theirs, abs=1e-6)
            compared += 1
        before = theirs
    assert (compared, triangular, stale) == (8, 2, 3)


@pytest.mark.parametrize("name", POLYGONS)
def test_every_stop_is_inside_the_polygon_and_near_its_hotspot(name):
    walk = dynamic_walks(POLYGONS[name], n=20, local_distance=40.0)
    # The tolerance of a millimetre allows for the rounding to float32.
    places = shapely.points(walk.stop.double().numpy())
    assert shapely.dwithin(POLYGONS[name], places, 1e-3).all()
    hotspots = 0
    for w, n in enumerate(walk.arrive.isfinite().sum(1).tolist()):
        stops = walk.stop[w, :n].tolist()
        speeds = walk.speed[w, :n].tolist()
        begins = [0] + [k + 1 for k in range(n - 1) if speeds[k] == DYNAMIC.speed]
        hotspots += len(begins)
        for begin, end in zip(begins, [*begins[1:], n], strict=True):
            assert 3 <= end - begin - 1 <= 7
            assert all(math.dist(stops[begin], stops[k]) <= 40.001 for k in range(begin, end))
    assert hotspots == 20 * 10


@given(
    seed=st.integers(0, 10**6),
    share=st.floats(0, 1.1),
    changed=st.fixed_dictionaries(
        {
            "speed": st.floats(0.5, 40),
            "acceleration": st.floats(0.05, 5),
            "max_stops": st.integers(1, 3),
            "n_hotspots": st.integers(1, 3),
        }
    ),
)
def test_a_position_equals_the_integrated_speed_profile(seed, share, changed):
    walk = dynamic_walks(
        n=3,
        seed=seed,
        min_stops=1,
        min_wait=0.0,
        max_wait=5.0,
        **changed,
    )
    walk = Walk(*(x if x.dtype == torch.bool else x.double() for x in walk))
    time = share * walk.depart[:, -1]
    located = locate(walk, time)
    for w in range(3):
        position, stop = twin_position(walk, w, time[w].item())
        assert located.position[w].tolist() == pytest.approx(position, abs=2e-2)
        assert located.stop[w].item() == stop


@given(
    seed=st.integers(0, 10**6),
    steps=st.integers(0, 10**9),
    dt=st.sampled_from([0.1, 1.0, 3.0, 60.0, 1 / 3]),
    n_hotspots=st.integers(1, 3),
)
def test_after_any_number_of_rounds_the_source_is_where_exact_arithmetic_says(
    seed, steps, dt, n_hotspots
):
    few = {
        "n_hotspots": n_hotspots,
        "min_stops": 1,
        "max_stops": 2,
        "min_wait": 0.5,
        "max_wait": 5.0,
    }
    walk = dynamic_walks(n=1, seed=seed, after_walk="loop", **few)
    located = locate(walk, torch.tensor([steps], dtype=torch.float64) * dt, loops=True)
    time = Fraction(steps * dt)  # as a float64 has it
    end = Fraction(walk.depart[0, -1].item())
    n = int(walk.arrive.isfinite().sum())  # the twin reaches the first stop a second time
    arrive = torch.cat([walk.arrive[:, :n], walk.depart[:, n : n + 1]], 1)
    again = Walk(*(field[:, : n + 1] for field in walk))._replace(arrive=arrive)
    place, stop = twin_position(again, 0, float(time % end))
    assert located.tour.item() == time // end
    assert located.stop.item() == stop
    assert located.position[0].tolist() == pytest.approx(place, abs=2e-2)
    assert not located.finished.any()
