"""Episodes on real regions as GeoJSON: valid by RFC 7946, and where they should be."""

import runpy
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import shapely
import torch
from geojson_pydantic import FeatureCollection
from shapely.geometry import shape

from damian import DelayConfig, ScenarioConfig, make_env
from damian.baselines.random import random_policy
from damian.server.config import ObservationConfig
from damian.show.episode import record
from damian.world.config import RegionConfig
from damian.world.regions.geodesy import to_local

EXAMPLE = Path(__file__).parents[2] / "examples" / "geojson_episode.py"


@pytest.fixture(scope="module")
def episode():
    """Ten steps of two UAVs over Llanbedr, with delays and a belief."""
    scenario = ScenarioConfig(
        agents=2,
        region=RegionConfig(kind="fir", path="damian:fir.csv", id="LlanbedrTest"),
        delay=DelayConfig(obs=3),
        observation=ObservationConfig(belief=["belief_moments"]),
    )
    torch.manual_seed(0)  # a fixture of the module is made before the seed of each test is set
    env = make_env(scenario, 1, seed=1, extras=["message", "state", "reward_terms"])
    return record(
        env.rollout(10, random_policy(env)), env.uav_env, {"began": "2023-11-14T22:13:59.500Z"}
    )[0]


feature_collection = runpy.run_path(str(EXAMPLE))["feature_collection"]


def local(feature, origin):
    """Corners of a feature's geometry in local metres, [C, 2]."""
    degrees = shapely.get_coordinates(shape(feature["geometry"]))
    return np.column_stack(to_local(degrees[:, 1], degrees[:, 0], origin))


def test_an_episode_is_valid_and_lies_where_it_was_flown(episode):
    collection = feature_collection(episode, 7)
    kinds = defaultdict(list)
    FeatureCollection.model_validate(collection)
    for feature in collection["features"]:
        kinds[feature["properties"]["kind"]].append(feature)
        geometry = shape(feature["geometry"])
        assert geometry.is_valid
        for part in shapely.get_parts(geometry):
            if part.geom_type == "Polygon":  # as RFC 7946 has it
                assert part.exterior.is_ccw
                assert not any(ring.is_ccw for ring in part.interiors)
    assert {name: len(found) for name, found in kinds.items() if name != "belief"} == {
        "region": 1,
        "landing points": 1,
        **dict.fromkeys(("track", "footprint", "coverage", "believed position"), 2),
        "source track": 1,
    }
    for uav in range(2):
        track, now, held = (
            kinds[kind][uav] for kind in ("track", "footprint", "believed position")
        )
        flown = episode.true[:8, uav]
        moved = (flown != flown[0]).any()
        np.testing.assert_allclose(
            local(track, episode.origin), flown if moved else flown[:1], atol=0.02
        )
        assert track["properties"]["times"] == episode.time[:8].tolist()
        assert track["properties"]["altitudes_m"] == episode.position[:8, uav, 2].round(2).tolist()
        assert track["properties"]["times_utc"][1] == "2023-11-14T22:14:00.500000+00:00"
        distance = np.linalg.norm(local(now, episode.origin) - episode.true[7, uav], axis=-1)
        np.testing.assert_allclose(distance, episode.radius, atol=0.02)
        np.testing.assert_allclose(local(held, episode.origin)[0], episode.true[4, uav], atol=0.02)
        assert held["properties"]["age_s"] == 3.0
    assert kinds["region"][0]["properties"]["name"] == "LlanbedrTest"
    assert kinds["source track"][0]["geometry"]["type"] == "Point"  # it does not move
    source = local(kinds["source track"][0], episode.origin)
    np.testing.assert_allclose(source, episode.source[0], atol=0.02)
