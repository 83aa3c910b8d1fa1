"""The scripted policy: its choices from the server's messages, and its return beside the random
policy's."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import both_kinds, both_motions, corners, everything, sent_messages, walking

from damian import DelayConfig, ScenarioConfig, keys, make_env
from damian.baselines.random import random_policy
from damian.baselines.script import Coverer, Seeker, script_policy
from damian.server.config import EpisodeConfig, ObservationConfig, RewardConfig
from damian.server.features.search import BLUR_M, RECENT, TRUST, likely_places
from damian.world.config import RegionConfig, SourceConfig
from damian.world.landing import ActionConfig, action_table, displacement

STARTS = [[50.0, 50.0], [200.0, 200.0], [360.0, 260.0]]
FINE = ActionConfig(distances=[50.0 * n for n in range(7)], headings=[22.5 * n for n in range(16)])
CONTINUOUS = ActionConfig(kind="continuous", distances=[300.0])
COVER = RewardConfig(spotted=0.0, coverage=1.0)
SEARCH = RewardConfig(spotted=0.0, spotting_agents=1.0)


def field(**changed):
    """Three UAVs across a large square, and a source in a corner that none of them hears at
    first."""
    region = RegionConfig(
        kind="vertices",
        vertices=corners(0.0, 0.0, 400.0, 400.0),
        lattice_step=32.0,
        initial_conditions=4,
        start_positions=STARTS,
    )
    sections = {
        "region": region,
        "source": SourceConfig(level_db=135.0, position=[390.0, 10.0]),
        "actions": FINE,
        "reward": SEARCH,
    }
    return make_env(ScenarioConfig(**(sections | changed)), 2, extras=["message"])


def landing_points(env, td):
    """Landing points to which the policy sends the UAVs of the first world, if all are free,
    [N, 2]."""
    action = script_policy(env)(td)["agents", "action"][0]
    worlds = env.uav_env
    if worlds.scenario.actions.kind == "discrete":
        distance, heading = action_table(worlds.scenario.actions)[action].unbind(-1)
    else:
        distance = action[:, 0] * 300.0
        heading = action[:, 1] * 2 * torch.pi
    target = sent_messages(td).position[0] + displacement(distance, heading)
    points = worlds.simulation.airspace.points[0]
    return points[torch.cdist(target, points).argmin(-1)]


def detection(env, place, ago=0.0, now=9.0):
    """A reset's output, changed to time ``now`` [s], with the second UAV's detection ``ago`` [s]
    earlier."""
    td = env.reset()
    held = sent_messages(td)
    second = torch.tensor([False, True, False])
    local = torch.tensor(place) - env.uav_env.simulation.airspace.offset[0]
    detected = torch.where(second.unsqueeze(-1), local, 0.0).expand_as(held.position)
    times = torch.where(second, now - ago, -1.0).expand_as(held.time)
    held = held._replace(
        time=torch.full_like(held.time, now),
        detected_time=times.unsqueeze(-1),
        detected_position=detected.unsqueeze(-2),
    )
    held = held._replace(spotted=(second & (ago == 0)).expand_as(held.spotted))
    return td.set(("agents", "message"), held.pack())


@pytest.mark.parametrize("actions", [FINE, CONTINUOUS])
def test_all_uavs_fly_to_the_latest_detection_and_the_uav_that_made_it_stays(actions):
    env = field(actions=actions)
    td = detection(env, [200.0, 200.0])
    place = sent_messages(td).position[0, 1]
    distance = torch.linalg.vector_norm(landing_points(env, td) - place, dim=-1)
    assert (distance <= env.uav_env.simulation.radius).all()
    assert distance[1] == 0


@pytest.mark.parametrize(
    ("sections", "seeks"),
    [
        ({}, False),
        ({"reward": replace(COVER, mean_distance=1.0)}, False),
        ({"episode": EpisodeConfig(success_share=0.5)}, True),
    ],
)
def test_without_a_reward_for_the_source_no_uav_flies_to_it(sections, seeks):
    observation = ObservationConfig(global_features=["coverage"], local_features=[])
    env = field(**{"reward": COVER, "observation": observation} | sections)
    ends = [landing_points(env, detection(env, place)) for place in ([200.0, 200.0], [50.0, 350.0])]
    assert torch.equal(*ends) is not seeks


@pytest.mark.parametrize("seed", range(4))
def test_the_likelihood_of_the_source_equals_a_loop_over_messages(seed):
    env = field(source=walking(emission="per_step", emission_probability=0.7))
    policy = Seeker(env.uav_env)
    radius = env.uav_env.simulation.radius
    torch.manual_seed(seed)
    places = 400 * torch.rand(2, 2, 3, 2)
    times = 8.0 + torch.randint(2, (2, 3))
    detected = torch.minimum(torch.tensor([-1.0, 0.0, 5.0, 9.0])[torch.randint(4, (2, 3))], times)
    held = sent_messages(env.reset())._replace(
        time=times, position=places[0], spotted=detected == times
    )
    in_flight = torch.rand(2, 3) < 0.3
    target = places[0] + 30 * in_flight.unsqueeze(-1)
    held = held._replace(
        detected_time=detected.unsqueeze(-1),
        detected_position=places[1].unsqueeze(-2),
        target=target,
    )
    ground = policy.points[[0, 0]]
    likely, recent = likely_places(
        held, ground, torch.full((2, 1), 9.0), policy.radius, policy.seeking
    )
    for world, spots in enumerate(held.spotted.tolist()):
        ages = [9 - time if time >= 0 else math.inf for time in detected[world].tolist()]
        confidence = TRUST * (1.0 if min(ages) == 0 else 0.7)
        uavs = zip(places[0, world], times[world], spots, in_flight[world], strict=True)
        silent = [
            place for place, time, spot, flies in uavs if time == 9 and not spot and not flies
        ]
        expected = []
        for place in ground[world].tolist():
            log = (
                math.log(1 - confidence)
                if any(math.dist(p, place) <= radius for p in silent)
                else 0.0
            )
            for age, detected_at in zip(ages, places[1, world].tolist(), strict=True):
                outside = max(math.dist(detected_at, place) - radius, 0.0)
                if age < math.inf:
                    log -= (outside / (BLUR_M + policy.seeking.speed * age / 2)) ** 2 / 2
            expected.append(log)
        best = max(expected)
        found = likely[world, 0].tolist()
        assert found == pytest.approx([math.exp(log - best) for log in expected], abs=1e-4)
        assert recent[world].item() == (min(ages) * policy.seeking.speed <= RECENT * radius)


@pytest.mark.parametrize("obs", [0, 3])
def test_uavs_choose_one_after_the_other_where_their_footprints_hold_most_new_ground(obs):
    observation = ObservationConfig(
        global_features=["coverage"], local_features=[], own=obs > 0, window=3
    )
    scenario = everything(
        reward=COVER,
        observation=observation,
        episode=EpisodeConfig(max_steps=9),
        delay=DelayConfig(obs=obs),
    )
    env = make_env(scenario, 8, extras=["message"])
    policy = Coverer(env.uav_env)
    radius = env.uav_env.simulation.radius
    td = env.rollout(6, random_policy(env))["next"][:, -1]
    sent = sent_messages(td)
    legal = td["agents", "action_mask"]
    held = env.uav_env.server.messages(td[keys.RECEIVED]) if obs else sent
    chosen = script_policy(env)(td)["agents", "action"]
    for world in range(8):
        region = int(held.trail[world, 0, 0]) // policy.points.shape[1]
        points = policy.points[region]
        claimed = []
        for uav in range(3):
            for known in (sent, held):
                latest = [points[p] for p in known.trail[world, uav, :-1] % len(points)]
                taken = torch.stack([*latest, *claimed])
                new = (distances(points, taken) > radius).all(-1).float()
                start = known.target[world, uav]
                if known is sent:
                    check_choice(env, region, start, new, legal[world, uav], chosen[world, uav])
            ends, gain, flown = ends_and_gains(env, region, start, new)
            best = gain == gain.max()  # the others expect it there, from what they know
            if held is sent:
                best = torch.arange(len(ends)) == chosen[world, uav]
            claimed.append(ends[torch.where(best, flown, torch.inf).argmin()])


def ends_and_gains(env, region, start, weight):
    """Where each action leads [A, 2], the weight in the footprint there, and the way [m], [A]."""
    simulation = env.uav_env.simulation
    points = simulation.airspace.points[region]
    points = points[points[:, 0].isfinite()]
    moves = displacement(*action_table(env.uav_env.scenario.actions).unbind(-1))
    ends = points[distances(start + moves, points).argmin(-1)]
    gain = (distances(ends, points) <= simulation.radius).float() @ weight[: len(points)]
    return ends, gain, distances(start.unsqueeze(0), ends)[0]


def check_choice(env, region, start, weight, legal, action):
    """Check that a legal action leads to where the footprint holds most weight, by the shortest
    flight."""
    _, gain, flown = ends_and_gains(env, region, start, weight)
    best = legal & (gain == gain[legal].max())
    assert best[action]
    assert flown[action] == pytest.approx(flown[best].min().item(), abs=1e-3)


def distances(some, others):
    """Exact distances [P, Q] between points [P, 2] and points [Q, 2]."""
    return torch.linalg.vector_norm(some.unsqueeze(1) - others, dim=-1)


@pytest.mark.sample(2)
@both_kinds
@both_motions
@pytest.mark.parametrize("obs", [0, 2])
def test_actions_are_legal_in_every_kind_of_region_and_do_not_depend_on_the_other_worlds(
    motion, kind, obs
):
    env = make_env(everything(motion, kind, delay=DelayConfig(obs=obs)), 16, extras=["message"])
    policy = script_policy(env)
    rollout = env.rollout(8, policy, break_when_any_done=False)
    action = rollout["agents", "action"]
    if kind == "discrete":
        mask = rollout["agents", "action_mask"]
        assert not mask.all()
        assert mask.gather(-1, action.unsqueeze(-1)).all()
    else:
        assert env.action_spec.contains(rollout[:, 0].select(*env.action_keys))
    two_worlds = rollout[3:5, 5].exclude(("agents", "action"))
    assert torch.equal(policy(two_worlds)["agents", "action"], action[3:5, 5])


def test_the_policy_reads_received_messages_and_not_sent_ones():
    env = field(delay=DelayConfig(obs=3))
    td = detection(env, [200.0, 200.0])
    policy = script_policy(env)
    without_detection = policy(env.reset())["agents", "action"]
    assert torch.equal(policy(td.clone())["agents", "action"], without_detection)
    td["agents", "received"] = td["agents", "message"]
    assert not torch.equal(policy(td)["agents", "action"], without_detection)
