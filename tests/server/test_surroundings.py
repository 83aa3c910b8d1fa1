"""Features of what surrounds a UAV equal plain loops over places and UAVs, in random regions."""

import math

import pytest
import shapely
import torch

from damian import DelayConfig, ScenarioConfig, keys, make_env
from damian.common.tensors import distances
from damian.server.config import ObservationConfig
from damian.server.features.coverage import RINGS, SECTORS, nearest_distance
from damian.server.features.others import OTHERS
from damian.world.config import MotionConfig, RegionConfig

REST = ["coverage_map", "place", "number"]
"""Features behind ``others``, in the order of the observation."""


def twin(env, messages, region, now, i):
    """The observation of UAV ``i`` of one world, by name, from the messages [N] that are known."""
    simulation = env.uav_env.simulation
    points = simulation.points
    radius = simulation.radius
    scale = simulation.airspace.scale[region].item()
    target = messages.target.tolist()
    place = messages.position.tolist()
    ways = []
    for j in range(len(target)):
        if j != i:
            to_place = [place[j][k] - target[i][k] for k in range(2)]
            to_target = [target[j][k] - target[i][k] for k in range(2)]
            way = [max(-1.0, min(1.0, w / (scale / 2))) for w in to_place + to_target]
            ways.append((math.hypot(*to_target), [*way, 1.0]))
    ways.sort()
    landed = [
        (points[p].tolist(), k) for trail in messages.trail for k, p in enumerate(trail.tolist())
    ]
    here = points[messages.trail[i, 0]].tolist()
    n = messages.trail.shape[-1]
    new = []
    for ring in RINGS:
        for sector in range(SECTORS):
            angle = 2 * math.pi * sector / SECTORS
            at = [
                here[0] + ring * radius * math.sin(angle),
                here[1] + ring * radius * math.cos(angle),
            ]
            inside = simulation.airspace.regions[region].polygon.contains(shapely.Point(at))
            value = min(math.dist(at, xy) / (2 * radius) + 0.5 * k / n for xy, k in landed)
            new.append(min(value, 1.0) if inside else 0.0)
    return {
        "coverage_map": new,
        "others": ways,
        "place": [max(-1, min(1, v / (scale / 2))) for v in target[i]],
        "number": [float(i % 5 == column) for column in range(5)],
    }


def check_others(rows, ways):
    """Compare the nearest other UAVs with those of the twin; equally far ones may stand in any
    order."""
    for row, (distance, _) in zip(rows.tolist(), ways, strict=False):
        assert any(
            row == pytest.approx(way, abs=1e-5)
            for other, way in ways
            if abs(other - distance) < 1e-2
        )
    assert not rows[len(ways) :].any()


@pytest.mark.parametrize(
    ("agents", "motion"),
    [
        (1, "instant"),
        (3, "instant"),
        (7, "polynomial"),
    ],
)
@pytest.mark.parametrize("own", [False, True])
def test_surroundings_equal_those_of_a_plain_loop(agents, motion, own):
    local = ["place", "number"]
    shared = ["others", "coverage_map"]
    scenario = ScenarioConfig(
        agents=agents,
        observation=ObservationConfig(local, shared, own=own, window=3),
        region=RegionConfig(kind="random", pool=2, lattice_step=60.0, initial_conditions=8),
        delay=DelayConfig(obs=2),
        motion=MotionConfig(kind=motion, max_speed=10.0),
    )
    env = make_env(scenario, 3, seed=agents, extras=["message"])
    steps = env.rollout(12, break_when_any_done=False)
    received = steps["next"][keys.RECEIVED]
    sent = steps["next"][keys.MESSAGE]
    observed = steps["next"][keys.OBSERVATION]
    server = env.uav_env.server
    for world in range(len(steps)):
        for step in range(0, steps.shape[1], 3):
            for i in range(agents):
                rows = received[world, step].clone()
                if own:
                    rows[i] = sent[world, step, i]
                messages = server.messages(rows)
                expected = twin(env, messages, int(server.region_of(messages)), step + 1, i)
                others, rest = observed[world, step, i].split([5 * OTHERS, 24 + 2 + 5])
                values = torch.tensor([number for name in REST for number in expected[name]])
                assert rest.allclose(values, atol=1e-5), (world, step, i)
                check_others(others.view(OTHERS, 5), expected["others"])


def test_the_nearest_place_compiled_is_at_the_smallest_distance():
    places = torch.rand(4, 3, 5, 2) * 400
    others = torch.rand(4, 3, 7, 2) * 400
    expected = torch.stack([distances(one, others) for one in places.split(1, -2)]).amin(0)
    compiled = torch.compile(nearest_distance, fullgraph=True, backend="aot_eager")
    for found in (nearest_distance(places, others), compiled(places, others)):
        torch.testing.assert_close(found, expected.squeeze(-2))
