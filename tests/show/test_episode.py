"""Episodes as data: recorded from a rollout, written to files and read again."""

import json
from dataclasses import replace

import numpy as np
import pytest
from episodes import flight

from damian import DelayConfig, ScenarioConfig, keys, make_env
from damian.baselines.random import random_policy
from damian.common.errors import InputError
from damian.server.config import EpisodeConfig, ObservationConfig, RewardConfig
from damian.show.episode import COLUMNS, Episode, record
from damian.world.config import BatteryConfig, SourceConfig
from damian.world.regions.region import local_places


@pytest.fixture(scope="module")
def flown():
    """A rollout [4, 40] in which every world ends, and the episodes that ended first."""
    source = SourceConfig(motion="dynamic", emission="per_step", emission_probability=0.5)
    scenario = ScenarioConfig(
        source=source,
        delay=DelayConfig(
            obs="0..4",
            loss=0.2,
        ),
        observation=ObservationConfig(belief=["belief_moments"]),
        episode=EpisodeConfig(max_steps=25),
    )
    env = make_env(scenario, 4, seed=5, extras=["message", "state", "reward_terms"])
    rollout = env.rollout(40, random_policy(env), break_when_any_done=False)
    return rollout, record(rollout, env.uav_env, {"policy": "random"})


def test_an_episode_ends_where_the_world_first_ends(flown):
    rollout, episodes = flown
    done = rollout["next", "done"].squeeze(-1)
    lengths = [next((t + 1 for t in range(40) if done[world, t]), 40) for world in range(4)]
    assert [episode.n_steps for episode in episodes] == lengths
    assert max(lengths) < 40
    successes = [bool(rollout["next", "success"][world, n - 1]) for world, n in enumerate(lengths)]
    assert [episode.success for episode in episodes] == successes
    assert [episode.about["world"] for episode in episodes] == [0, 1, 2, 3]


def test_rewards_and_beliefs_are_those_of_the_rollout_after_each_step(flown):
    rollout, episodes = flown
    for world, episode in enumerate(episodes):
        after = rollout["next"][world, : episode.n_steps]
        reward = np.concatenate([np.zeros((1, 3)), after[keys.REWARD].squeeze(-1).numpy()])
        assert np.array_equal(episode.reward, reward)
        np.testing.assert_allclose(sum(episode.reward_terms.values()), reward, atol=1e-5)
        assert np.array_equal(episode.belief[1:], after[keys.BELIEF].numpy())
        assert episode.belief.shape[2] == len(episode.cells)
        assert replace(episode, belief=np.full((1, 2, 8), 1 / 8)).entropy(0) == 6
        assert episode.perceived_return == pytest.approx(reward.mean(-1).sum())


@pytest.mark.parametrize(
    ("weight", "n_sources"),
    [
        (0.0, 0),
        (1.0, 1),
    ],
)
def test_an_episode_of_a_task_without_a_source_has_none(weight, n_sources, tmp_path):
    scenario = ScenarioConfig(reward=RewardConfig(coverage=1.0, spotted=weight))
    env = make_env(scenario, 1, seed=5, extras=["message", "state"])
    (episode,) = record(env.rollout(20, random_policy(env)), env.uav_env, {})
    episode.save(tmp_path / "episode.json")
    for each in (episode, Episode.load(tmp_path / "episode.json")):
        assert each.source.shape[1] == each.emits.shape[1] == n_sources
        assert each.has_source == each.spotted.any() == bool(n_sources)


def test_a_file_holds_the_episode_to_five_digits_and_says_what_its_columns_mean(flown, tmp_path):
    for episode in flown[1]:
        episode.save(tmp_path / "episode.json")
        again = Episode.load(tmp_path / "episode.json")
        for name in COLUMNS:
            one = getattr(episode, name)
            other = getattr(again, name)
            if one is None:
                assert other is None
                continue
            pairs = one.items() if isinstance(one, dict) else [(None, one)]
            for key, values in pairs:
                found = other if key is None else other[key]
                np.testing.assert_allclose(found, values, rtol=5.1e-5, atol=1e-30)
                assert found.dtype == bool if values.dtype == bool else found.shape == values.shape
        assert again.region.equals_exact(episode.region, 1e-9)
        assert (again.about, again.success, again.origin) == (
            episode.about,
            episode.success,
            episode.origin,
        )
    stored = json.loads((tmp_path / "episode.json").read_text())
    assert (stored["schema"], stored["version"]) == ("damian-episode", 3)
    assert set(stored["meaning"]) == set(COLUMNS) <= set(stored)


def test_a_file_that_holds_no_episode_is_refused_in_one_line(tmp_path):
    path = tmp_path / "episode.json"
    path.write_text(json.dumps({**flight().document(), "version": 2}))
    with pytest.raises(
        InputError, match=r"episode\.json: it is not an episode of version 3: it is .* 2$"
    ):
        Episode.load(path)


def test_an_episode_knows_the_landing_points_that_charge_if_not_all_do():
    places = [[120.0, 80.0], [30.0, 200.0]]
    for chosen in (None, places):
        scenario = ScenarioConfig(battery=BatteryConfig(enabled=True, charging_points=chosen))
        env = make_env(scenario, 1, seed=0, extras=["message", "state"])
        episode = record(env.rollout(1, random_policy(env)), env.uav_env, {})[0]
        if chosen is None:
            assert "charging_points" not in episode.about
    points = episode.landing_points.astype(float)
    local = local_places("places", places, env.simulation.airspace.regions[0])
    distances = np.linalg.norm(points - np.asarray(local)[:, None], axis=-1)
    nearest = {tuple(points[point].round(1)) for point in distances.argmin(1)}
    assert {tuple(np.round(place, 1)) for place in episode.about["charging_points"]} == nearest
