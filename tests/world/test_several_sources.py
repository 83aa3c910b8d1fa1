"""Several sources, against one source at a time and plain loops; and the script that shares them
out."""

import pytest
import torch
from helpers import corners

from damian import ScenarioConfig, UavEnv, make_env
from damian.baselines.script import script_policy
from damian.common.errors import InputError
from damian.server.config import EpisodeConfig, ObservationConfig, RewardConfig
from damian.world.config import RegionConfig, SourceConfig
from damian.world.state import Truth

PLACES = [[60.0, 60.0], [340.0, 80.0], [200.0, 240.0]]
LEVELS = [138.0, 141.0, 135.0]
SQUARE = RegionConfig(kind="vertices", vertices=corners(0, 0, 400, 300), initial_conditions=8)
EACH = [
    {
        "position": place,
        "level_db": level,
    }
    for place, level in zip(PLACES, LEVELS, strict=True)
]


def scenario(source, **changed):
    settings = {
        "region": SQUARE,
        "source": source,
        "observation": ObservationConfig(
            global_features=["source_distance", "source_bearing", "source_time"]
        ),
        "episode": EpisodeConfig(60),
    }
    return ScenarioConfig(agents=3, **settings | changed)


def test_features_tell_of_the_nearest_source_and_of_the_newest_detection():
    together = UavEnv(scenario(SourceConfig(count=3, each=EACH)), 8, seed=1)
    alone = [UavEnv(scenario(SourceConfig(**each)), 8, seed=1) for each in EACH]
    for env in (together, *alone):
        env.set_seed(3)
        env.reset()
        start = together.state.goal
        place = env.simulation.points[start]
        at = torch.cat([place, torch.zeros_like(place[..., :1])], -1)
        moved = env.state._replace(goal=start, origin=start, position=at)
        env.state = env.simulation._first_messages(moved)
    for _ in range(25):
        action = torch.randint(40, (8, 3))
        for env in (together, *alone):
            env.worlds, _ = env.step_fn(env.worlds, action)
    sent = together.state.sent
    assert (sent.detected_time > 0).any(dim=0).all()
    features = together.server.features(sent, together.state.steps)
    ones = [env.server.features(env.state.sent, env.state.steps) for env in alone]
    known = torch.stack([(env.state.sent.detected_time >= 0).any(1).expand(-1, 3) for env in alone])
    far = torch.stack([one["source_distance"] for one in ones]).masked_fill(~known, 1.0)
    assert features["source_distance"].equal(far.amin(0))
    chosen = far.argmin(0, keepdim=True)
    bearing = torch.stack([one["source_bearing"] for one in ones]).gather(0, chosen)[0]
    assert features["source_bearing"].equal(torch.where(known.any(0), bearing, 1.0))
    newest = torch.stack([one["source_time"] for one in ones]).amin(0)
    assert features["source_time"].equal(newest)


def test_alike_sources_walk_and_fall_silent_independently():
    source = SourceConfig(
        count=4, motion="dynamic", emission="per_step", min_wait=1.0, max_wait=2.0
    )
    env = UavEnv(scenario(source), 16, seed=0)
    states = env.rollout(40, break_when_any_done=False)["state"]
    truth = Truth.unpack(states, env.simulation.widths)
    share = truth.emits.float().mean((0, 1))
    assert ((share - 0.5).abs() < 0.1).all()
    pairs = torch.corrcoef(truth.emits.flatten(0, 1).T.float()).fill_diagonal_(0)
    assert pairs.abs().max() < 0.2
    moved = (truth.source[:, 1:] - truth.source[:, :-1]).norm(dim=-1)
    assert (moved.sum(1) > 0).all()
    assert len(truth.source[0, 0].unique(dim=0)) == 4


def test_the_script_finds_more_than_chance():
    source = SourceConfig(count=3, level_db=140.0)
    told = scenario(
        source, episode=EpisodeConfig(60, all_sources=True), reward=RewardConfig(bonus=1.0)
    )
    env = make_env(told, 32, 0, "cpu", ["message", "state"])
    found = []
    for policy in (script_policy(env), None):
        env.set_seed(0)
        rollout = env.rollout(60, policy, break_when_any_done=False, auto_reset=True)
        found.append(rollout["next", "success"].any(1).float().mean().item())
    assert found[0] > found[1] + 0.2


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"count": 2, "each": [{}]}, "source.each: .* one mapping for each of the source.count=2"),
        ({"count": 1, "each": [{"loud": 3}]}, "source.each: .* settings of a source"),
    ],
)
def test_sources_that_cannot_be_are_refused(changed, message):
    with pytest.raises(InputError, match=message):
        SourceConfig(**changed)
