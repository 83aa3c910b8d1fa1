"""The scripted policy: what it makes of the server's messages, and how far that gets it."""

import itertools
import math
from dataclasses import replace

import pytest
import torch
from helpers import clock, everything, told, walking
from tensordict import TensorDictBase
from torch import Tensor

from damian.baselines.greedy import BLUR_M, RECENT, TRUST, Greedy, greedy_policy
from damian.baselines.random import random_policy
from damian.delays.config import DelayConfig
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.envs.scenario import ScenarioConfig
from damian.evaluation.metrics import evaluate
from damian.server.features import ObservationConfig
from damian.server.rewards import RewardConfig
from damian.server.termination import EpisodeConfig
from damian.world.landing import ActionConfig, displacement
from damian.world.regions.config import RegionConfig
from damian.world.signal_source import SourceConfig

FIELD = [[0.0, 0.0], [400.0, 0.0], [400.0, 400.0], [0.0, 400.0]]
STARTS = [[50.0, 50.0], [200.0, 200.0], [360.0, 260.0]]
FINE = ActionConfig(distances=[50.0 * n for n in range(7)], headings=[22.5 * n for n in range(16)])
CONTINUOUS = ActionConfig(kind="continuous", distances=[300.0])
COVER = RewardConfig(spotted=0.0, coverage=1.0)
SEARCH = RewardConfig(spotted=0.0, spotting_agents=1.0)


def field(**changed) -> DelayedEnv:
    """Three UAVs across a large square; a source in a corner that none of them hears."""
    region = RegionConfig(
        kind="vertices", vertices=FIELD, lattice_step=32.0, initial_conditions=4, start_positions=STARTS
    )
    sections = {
        "region": region,
        "source": SourceConfig(level_db=135.0, position=[390.0, 10.0]),
        "actions": FINE,
        "reward": SEARCH,
    }
    return make_env(ScenarioConfig(**(sections | changed)), 2, extras=["message"])


def landing(env: DelayedEnv, shown: TensorDictBase) -> Tensor:
    """Where the policy sends the UAVs of the first world, if alone there, [N, 2]."""
    action = greedy_policy(env)(shown)["agents", "action"][0]
    worlds = env.uav_env
    if worlds.scenario.actions.kind == "discrete":
        distance, heading = worlds.scenario.actions.table()[action].unbind(-1)
    else:
        distance, heading = action[:, 0] * 300.0, action[:, 1] * 2 * torch.pi
    target = told(shown).position[0] + displacement(distance, heading)
    points = worlds.simulation.airspace.points[0]
    return points[torch.cdist(target, points).argmin(-1)]


def heard(env: DelayedEnv, place: list[float], ago: float = 0.0, now: float = 9.0) -> TensorDictBase:
    """What is shown at a time if the second UAV has heard the source so long ago at a place."""
    shown = env.reset()
    held = told(shown)
    second = torch.tensor([False, True, False])
    detected = torch.where(second.unsqueeze(-1), torch.tensor(place), 0.0).expand_as(held.position)
    times = torch.where(second, now - ago, -1.0).expand_as(held.time)
    held = held._replace(
        time=torch.full_like(held.time, now), detected_time=times, detected_position=detected
    )
    held = held._replace(spotted=(second & (ago == 0)).expand_as(held.spotted))
    return shown.set(("agents", "message"), held.pack())


@pytest.mark.parametrize("actions", [FINE, CONTINUOUS], ids=["discrete", "continuous"])
def test_all_fly_to_where_one_has_heard_the_source_and_that_one_stays(actions):
    env = field(actions=actions)
    shown = heard(env, [200.0, 200.0])
    there = told(shown).position[0, 1]
    apart = torch.linalg.vector_norm(landing(env, shown) - there, dim=-1)
    assert (apart <= env.uav_env.simulation.radius).all()
    assert apart[1] == 0


def test_what_was_heard_long_ago_of_a_source_at_rest_still_counts_but_of_one_that_moves_does_not():
    moving = SourceConfig(level_db=135.0, motion="dynamic", speed=20.0)
    ends = [landing(env, heard(env, [200.0, 200.0], 8)) for env in (field(), field(source=moving))]
    apart = [torch.cdist(end[::2], torch.tensor([[200.0, 200.0]])) for end in ends]
    radius = field().uav_env.simulation.radius
    assert (apart[0] <= 2 * radius).all()
    assert (apart[1] > 2 * radius).all()


def test_a_source_just_lost_is_looked_for_around_the_silent_footprint_and_not_in_it():
    env = field(source=SourceConfig(level_db=135.0, motion="dynamic", speed=20.0))
    shown = heard(env, [200.0, 200.0], ago=2.0)
    away = torch.linalg.vector_norm(landing(env, shown)[1] - told(shown).position[0, 1])
    assert env.uav_env.simulation.radius < away < 3 * env.uav_env.simulation.radius


@pytest.mark.parametrize("task", [SEARCH, COVER], ids=["search", "coverage"])
def test_before_anything_is_heard_the_uavs_leave_for_fresh_ground_of_their_own(task):
    env = field(reward=task)
    shown = env.reset()
    start, end = told(shown).position[0], landing(env, shown)
    apart = torch.cdist(end, start)
    assert (apart.diagonal() > env.uav_env.simulation.radius).all()
    assert torch.equal(apart.argmin(-1), torch.arange(3))


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_a_source_beyond_reach_is_flown_to_as_far_as_can_be(kind):
    env = field(actions=replace(FINE, kind=kind))
    shown, there = heard(env, [380.0, 380.0]), torch.tensor([380.0, 380.0])
    start, end = told(shown).position[0, 0], landing(env, shown)[0]
    assert (start - there).norm() > 300 + env.uav_env.simulation.radius
    assert (start - there).norm() - (end - there).norm() > 250


@pytest.mark.parametrize(
    ("sections", "seeks"),
    [
        ({}, False),
        ({"reward": replace(COVER, mean_distance=1.0)}, False),
        ({"episode": EpisodeConfig(success_share=0.5)}, True),
    ],
)
def test_without_a_reward_for_the_source_nobody_flies_to_it(sections, seeks):
    seen = ObservationConfig(global_features=["coverage"], local_features=[])
    env = field(**{"reward": COVER, "observation": seen} | sections)
    ends = [landing(env, heard(env, place)) for place in ([200.0, 200.0], [50.0, 350.0])]
    assert torch.equal(*ends) is not seeks


def test_fresh_ground_is_ones_own_and_under_none_of_ones_latest_footprints():
    env = make_env(everything(), 4, extras=["message"])
    policy, held = Greedy(env.uav_env), told(env.rollout(4, random_policy(env))["next"][:, -1])
    assert (held.trail[..., 0] != held.trail[..., 1]).any()
    points, been = policy.points.flatten(0, 1).tolist(), held.trail.tolist()
    ground = policy.points[held.trail[:, 0, 0] // policy.points.shape[1]]
    fresh = policy.fresh(held, ground).tolist()
    for world, targets in enumerate(held.target.tolist()):
        for place, *found in zip(ground[world].tolist(), *fresh[world], strict=True):
            apart = [math.dist(target, place) for target in targets]
            for uav, trail in enumerate(been[world]):
                covered = any(math.dist(points[flat], place) <= policy.radius for flat in trail)
                assert found[uav] == (apart[uav] == min(apart) and not covered)


@pytest.mark.parametrize("seed", range(4))
def test_what_is_believed_of_a_place_is_what_one_uav_after_the_other_says_of_it(seed):
    env = field(source=walking(emission="per_step", emission_probability=0.7))
    policy, radius = Greedy(env.uav_env), env.uav_env.simulation.radius
    torch.manual_seed(seed)
    places, times = 400 * torch.rand(2, 2, 3, 2), 8.0 + torch.randint(2, (2, 3))
    detected = torch.minimum(torch.tensor([-1.0, 0.0, 5.0, 9.0])[torch.randint(4, (2, 3))], times)
    held = told(env.reset())._replace(time=times, position=places[0], spotted=detected == times)
    held = held._replace(detected_time=detected, detected_position=places[1])
    ground = policy.points[[0, 0]]
    likely, recent = policy.believe(held, ground, torch.full((2, 1), 9.0))
    for world, spots in enumerate(held.spotted.tolist()):
        ages = [9 - time if time >= 0 else math.inf for time in detected[world].tolist()]
        sure = TRUST * (1.0 if min(ages) == 0 else 0.7)
        silent = [
            p for p, t, spot in zip(places[0, world], times[world], spots, strict=True) if t == 9 and not spot
        ]
        expected = []
        for place in ground[world].tolist():
            log = math.log(1 - sure) if any(math.dist(p, place) <= radius for p in silent) else 0.0
            for age, there in zip(ages, places[1, world].tolist(), strict=True):
                outside = max(math.dist(there, place) - radius, 0.0)
                if age < math.inf:
                    log -= (outside / (BLUR_M + policy.speed * age / 2)) ** 2 / 2
            expected.append(log)
        most = max(expected)
        assert likely[world, 0].tolist() == pytest.approx(
            [math.exp(log - most) for log in expected], abs=1e-4
        )
        assert recent[world].item() == (min(ages) * policy.speed <= RECENT * radius)


def test_the_uavs_fly_where_most_fresh_ground_is_seen_and_there_the_shortest_way():
    scenario = everything(reward=COVER, episode=EpisodeConfig(max_steps=9))
    env = make_env(scenario, 8, extras=["message"])
    policy, radius = Greedy(env.uav_env), env.uav_env.simulation.radius
    shown = env.rollout(4, random_policy(env))["next"][:, -1]
    held, legal = told(shown), shown["agents", "action_mask"]
    region = held.trail[:, 0, 0] // policy.points.shape[1]
    assert len(region.unique()) == 3
    fresh, chosen = policy.fresh(held, policy.points[region]), greedy_policy(env)(shown)["agents", "action"]
    moves = displacement(*scenario.actions.table().unbind(-1))
    for world, uav in itertools.product(range(8), range(3)):
        points, start = policy.points[region[world]][policy.real[region[world]]], held.position[world, uav]
        ends = points[apart(start + moves, points).argmin(-1)]
        seen = (apart(ends, points) <= radius).float() @ fresh[world, uav, : len(points)]
        far = apart(start.unsqueeze(0), ends)[0]
        most = seen[legal[world, uav]].max()
        best = legal[world, uav] & (seen == most)
        action = chosen[world, uav]
        assert best[action]
        assert far[action] == pytest.approx(far[best].min().item(), abs=1e-3)


def apart(some: Tensor, others: Tensor) -> Tensor:
    """Distances [P, Q], exact."""
    return torch.linalg.vector_norm(some.unsqueeze(1) - others, dim=-1)


def test_nobody_flies_further_than_a_continuous_action_reaches():
    env = field(actions=ActionConfig(kind="continuous", distances=[100.0]))
    action = greedy_policy(env)(heard(env, [200.0, 45.0]))["agents", "action"]
    assert 0 < action[..., 0].max() <= 1


def test_it_is_as_late_as_the_newest_message_says():
    env = field(source=SourceConfig(level_db=135.0, motion="dynamic", speed=20.0))
    shown = heard(env, [200.0, 200.0], 8)
    held, flying = told(shown), torch.tensor([True, False, False])
    older = held._replace(time=torch.where(flying, 1.0, held.time)).pack()
    ends = [landing(env, td) for td in (shown, shown.clone().set(("agents", "message"), older))]
    assert torch.equal(ends[0][1:], ends[1][1:])


def test_lateness_counts_in_seconds():
    moving = SourceConfig(level_db=135.0, motion="dynamic", speed=20.0)
    actions = []
    for period, age in (("1s", 9), ("3s", 3), ("1s", 3)):
        env = field(delay=DelayConfig(obs=9), source=moving, clock=clock(period))
        shown = heard(env, [200.0, 200.0])
        shown["agents", "received"] = shown["agents", "message"]
        shown["agents", "age"].fill_(age)
        actions.append(greedy_policy(env)(shown)["agents", "action"])
    assert torch.equal(actions[0], actions[1])
    assert not torch.equal(actions[0], actions[2])


def test_long_after_a_detection_fresh_ground_near_it_is_searched_first():
    moving = SourceConfig(level_db=135.0, motion="dynamic", speed=20.0)
    env = field(source=moving)
    ends = [landing(env, heard(env, place, 8)) for place in ([100.0, 350.0], [350.0, 100.0])]
    assert not torch.equal(*ends)


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
@pytest.mark.parametrize("motion", ["instant", "polynomial"])
@pytest.mark.parametrize("obs", [0, 2])
def test_actions_are_legal_in_every_kind_of_region_and_do_not_depend_on_the_other_worlds(kind, motion, obs):
    env = make_env(everything(motion, kind, delay=DelayConfig(obs=obs)), 16, extras=["message"])
    policy = greedy_policy(env)
    flown = env.rollout(8, policy, break_when_any_done=False)
    action = flown["agents", "action"]
    if kind == "discrete":
        mask = flown["agents", "action_mask"]
        assert not mask.all()
        assert mask.gather(-1, action.unsqueeze(-1)).all()
    else:
        assert env.action_spec.contains(flown[:, 0].select(*env.action_keys))
    seen = flown[3:5, 5].exclude(("agents", "action"))
    assert torch.equal(policy(seen)["agents", "action"], action[3:5, 5])


def test_regions_of_different_sizes_have_their_own_ground_only():
    env = make_env(everything(), 2, extras=["message"])
    seen = Greedy(env.uav_env).near.sum(1)
    for region, points in enumerate(env.uav_env.simulation.airspace.points):
        real = points[points[:, 0].isfinite()]
        apart = torch.linalg.vector_norm(real.unsqueeze(0) - real.unsqueeze(1), dim=-1)
        near = (apart <= env.uav_env.simulation.radius).sum(0)
        assert torch.equal(seen[region, : len(real)], near.float())
    assert not env.uav_env.simulation.airspace.points.isfinite().all()


@pytest.mark.parametrize("actions", [FINE, CONTINUOUS], ids=["discrete", "continuous"])
def test_of_equally_good_places_the_nearest_is_flown_to(actions):
    env = make_env(everything(actions=actions), 4, extras=["message"])
    policy = Greedy(env.uav_env)
    assert not policy.real.all()
    # What only fills the table of a smaller region is no place, however much it promises.
    policy.near = (~policy.real).float().unsqueeze(1).expand_as(policy.near)
    action = policy(env.reset()["agents", "message"])
    distance = actions.table()[action, 0] if actions is FINE else action[..., 0]
    assert (distance == 0).all()


def test_it_knows_what_has_arrived_and_not_what_was_sent():
    env = field(delay=DelayConfig(obs=3))
    shown, policy = heard(env, [200.0, 200.0]), greedy_policy(env)
    blind = policy(env.reset())["agents", "action"]
    assert torch.equal(policy(shown.clone())["agents", "action"], blind)
    shown["agents", "received"] = shown["agents", "message"]
    assert not torch.equal(policy(shown)["agents", "action"], blind)


def test_late_messages_make_what_was_heard_old():
    env = field(delay=DelayConfig(obs=9), source=SourceConfig(level_db=135.0, motion="dynamic", speed=20.0))
    shown, policy = heard(env, [200.0, 200.0]), greedy_policy(env)
    shown["agents", "received"] = shown["agents", "message"]
    fresh = policy(shown.clone())["agents", "action"]
    shown["agents", "age"] += 9
    assert not torch.equal(policy(shown)["agents", "action"], fresh)


def test_any_number_of_uavs_is_flown_and_clearly_better_than_by_chance():
    torch.manual_seed(0)
    region = RegionConfig(min_area=60_000, max_area=90_000, pool=2, initial_conditions=16)
    for agents in (1, 3, 7):
        scenario = ScenarioConfig(agents=agents, region=region, source=walking(), reward=SEARCH)
        env = make_env(scenario, 32, 5, extras=["message"])
        scores = []
        for policy in (greedy_policy(env), random_policy(env)):
            env.set_seed(5)
            scores.append(evaluate(env, policy, 50).true_return)
        assert scores[0] > 2 * scores[1]
