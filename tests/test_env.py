"""The environment: TorchRL's contract, batches against loops, a slow twin, every end by hand."""

import copy
import itertools
import math
import pickle

import numpy as np
import pytest
import shapely
import torch
import twin
from helpers import (
    KINDS,
    REGIONS,
    SQUARE,
    act,
    all_same,
    clock,
    everything,
    heading,
    play,
    random_actions,
    same,
    square,
    usecase,
    walking,
)
from torchrl.envs import ParallelEnv, SerialEnv
from torchrl.envs.utils import check_env_specs

from damian.actions import ActionConfig
from damian.env import UavEnv
from damian.features import GLOBAL, LOCAL, ObservationConfig
from damian.rewards import INDIVIDUAL, SYSTEM, EpisodeConfig, RewardConfig
from damian.scenario import RegionConfig, ScenarioConfig
from damian.state import State
from damian.world.battery import BatteryConfig, charge_gain, flight_drain
from damian.world.motion import MotionConfig
from damian.world.source import SourceConfig

MOTIONS = {
    "instant": MotionConfig(),
    "polynomial": MotionConfig("polynomial", max_speed=20.0, max_acceleration=10.0),
}
FLYING = MOTIONS["polynomial"]
KEEPS_GOING = EpisodeConfig(max_steps=None)

both_motions = pytest.mark.parametrize("motion", ["instant", "polynomial"])
both_kinds = pytest.mark.parametrize("kind", ["discrete", "continuous"])


def fields(state: State) -> dict[str, torch.Tensor]:
    """Every tensor of a state by name."""
    return state._asdict() | {f"sent.{k}": v for k, v in state.sent._asdict().items()} | {"sent": 0}


def check_equal(one: State, other: State, rows=slice(None)):
    """Equal bit for bit in some worlds."""
    pairs = {name: (value, fields(other)[name]) for name, value in fields(one).items()}
    for name, (a, b) in pairs.items():
        if name != "sent":
            assert a[rows].equal(b[rows]), name


def one_uav(**changed) -> ScenarioConfig:
    """One UAV in the square, at (100, 100) at first, the source 300 m away and not heard."""
    region = RegionConfig(
        kind="vertices",
        vertices=[[0.0, 0.0], [400.0, 0.0], [400.0, 200.0], [0.0, 200.0]],
        situations=1,
        start_positions=[[60.0, 100.0]],
    )
    sections = {
        "agents": 1,
        "region": region,
        "source": SourceConfig(level_db=130.0, position=[390.0, 100.0]),
        "episode": KEEPS_GOING,
        "actions": ActionConfig(kind="continuous", distances=[0.0, 100.0]),
    }
    return ScenarioConfig(**(sections | changed))


HERE = [[0.0, 0.0]]
EAST, WEST = [[1.0, heading(90)]], [[1.0, heading(270)]]
"""Continuous actions of one UAV: hold, 100 m east, 100 m west."""


def go(env: UavEnv, *actions):
    """Step with each action in every world; what the last step showed."""
    for action in actions:
        after = act(env, torch.tensor(action).expand(*env.batch_size, env.n_agents, 2))
    return after


def fresh(scenario: ScenarioConfig, num_worlds: int = 1, **options) -> UavEnv:
    env = UavEnv(scenario, num_worlds=num_worlds, **options)
    env.reset()
    return env


# TorchRL's contract.


@pytest.mark.parametrize("region", REGIONS)
@both_kinds
@both_motions
@pytest.mark.parametrize("scenario", KINDS)
def test_every_kind_of_scenario_keeps_its_specs(scenario, motion, kind, region):
    config = ScenarioConfig(
        **KINDS[scenario],
        agents=2,
        region=REGIONS[region],
        motion=MOTIONS[motion],
        actions=ActionConfig(kind=kind, distances=[0.0, 60.0], headings=[0.0, 90.0, 180.0, 270.0]),
    )
    check_env_specs(UavEnv(config, num_worlds=2), seed=0, break_when_any_done="both")


@both_kinds
@both_motions
def test_all_observations_lie_between_0_and_1_and_no_reward_is_lost(motion, kind):
    env = UavEnv(everything(motion, kind), num_worlds=16)
    generator = torch.Generator().manual_seed(0)
    td = env.rollout(40, lambda td: td.set(*chosen(env, generator)), break_when_any_done=False)
    for name in ("observation", "global_observation"):
        seen = td["next", "agents", name]
        assert ((seen >= 0) & (seen <= 1)).all()
    terms = td["next", "agents", "reward_terms"]
    assert set(terms.keys()) == {*INDIVIDUAL, *SYSTEM}
    extra = td["next", "agents", "reward"].squeeze(-1) - sum(terms.values())
    paid = 1.0 * td["next", "success"] - 0.25 * (td["next", "done"] & ~td["next", "success"])
    torch.testing.assert_close(extra, paid.expand_as(extra), atol=1e-5, rtol=0)
    assert td["next", "done"].any()


def chosen(env, generator):
    return ("agents", "action"), random_actions(env, generator)


@both_motions
def test_an_environment_can_be_pickled_and_goes_on_alike(motion):
    env = fresh(everything(motion), num_worlds=3)
    generator = torch.Generator().manual_seed(0)
    act(env, random_actions(env, generator))
    twin_env = pickle.loads(pickle.dumps(env))
    for _ in range(5):
        action = random_actions(env, generator)
        assert same(act(env, action), act(twin_env, action))


@pytest.mark.parametrize("vector", [SerialEnv, ParallelEnv])
def test_vectors_of_environments_work(vector):
    env = vector(2, make_small)
    try:
        td = env.rollout(8, break_when_any_done=False)
    finally:
        env.close()
    assert td.shape == (2, 3, 8)
    assert td["next", "done"].any()


def make_small():
    return UavEnv(square(), num_worlds=3)


@both_motions
def test_without_extras_observations_and_rewards_are_the_same(motion):
    scenario = everything(motion)
    generator = torch.Generator().manual_seed(0)
    rich, poor = (fresh(scenario, num_worlds=4, extras=e) for e in (("message", "state"), ()))
    actions = [random_actions(rich, generator) for _ in range(12)]
    n_differences = 0
    for one, other in zip(play(rich, actions), play(poor, actions), strict=True):
        assert same(one.select(*other.keys(True, True)), other)
        n_differences += len(set(one.keys(True, True)) - set(other.keys(True, True)))
    assert n_differences > 0
    kept = {"reward_terms", "message", "talks"} & set(poor.reset()["agents"].keys())
    assert not kept
    assert "state" not in poor.reset()


# Worlds and seeds.


@both_kinds
@both_motions
def test_worlds_stepped_together_equal_worlds_stepped_alone(motion, kind):
    n_worlds = 3
    together = UavEnv(everything(motion, kind), num_worlds=n_worlds, seed=5)
    alone = UavEnv(everything(motion, kind), num_worlds=1, seed=5)
    generator = torch.Generator().manual_seed(1)
    actions = [random_actions(together, generator) for _ in range(30)]
    seeds = torch.tensor([11, 12, 13])
    together.seed_worlds(seeds)
    expected = play(together, actions)
    assert torch.stack([td["done"] for td in expected]).sum() >= 2 * n_worlds
    for b in range(n_worlds):
        alone.seed_worlds(seeds[b : b + 1])
        shown = play(alone, [a[b : b + 1] for a in actions])
        assert all_same(shown, [td[b : b + 1] for td in expected])


@both_motions
def test_a_partial_reset_touches_only_its_worlds(motion):
    env = fresh(everything(motion), num_worlds=6)
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        after = act(env, random_actions(env, generator))
    before = copy.deepcopy(env.state)
    mask = torch.tensor([True, False, False, True, False, False])
    shown = env.reset(after.exclude("reward").set("_reset", mask[:, None]))
    check_equal(before, env.state, ~mask)
    assert env.state.steps.tolist() == [0, 3, 3, 0, 3, 3]
    assert env.state.episode.tolist() == [2, 1, 1, 2, 1, 1]
    keys = [("agents", "observation"), ("agents", "message"), "state"]
    assert same(shown.select(*keys)[~mask], after.select(*keys)[~mask])
    assert not same(shown.select(*keys)[mask], after.select(*keys)[mask])


@both_kinds
@both_motions
def test_the_same_seed_gives_the_same_rollout_and_another_seed_another(motion, kind):
    def rollout(seed):
        env = UavEnv(everything(motion, kind), num_worlds=2, seed=seed)
        generator = torch.Generator().manual_seed(0)
        return play(env, lambda _: random_actions(env, generator), 12)

    assert all_same(rollout(3), rollout(3))
    assert not all_same(rollout(3), rollout(4))


def test_set_seed_repeats_a_rollout_and_worlds_and_episodes_differ():
    env = UavEnv(everything(), num_worlds=8)
    generator = torch.Generator().manual_seed(0)
    actions = [random_actions(env, generator) for _ in range(12)]

    def rollout(seed):
        env.set_seed(seed)
        return play(env, actions)

    first = rollout(7)
    assert all_same(first, rollout(7))
    assert not all_same(first, rollout(8))
    starts = {tuple(world) for world in first[0]["state"].tolist()}
    assert len(starts) > 3
    assert len({int(env.reset()[0]["state"].sum() * 100) for _ in range(20)}) > 3


# Where UAVs stand.


@both_kinds
@both_motions
@pytest.mark.parametrize("n_agents", [2, 5, 8])
@pytest.mark.parametrize("together", [False, True])
def test_uavs_stand_on_landing_points_of_their_own_inside_the_region(n_agents, kind, motion, together):
    region = RegionConfig(
        kind="vertices",
        vertices=[[0.0, 0.0], [90.0, 0.0], [90.0, 40.0], [40.0, 40.0], [40.0, 90.0], [0.0, 90.0]],
        lattice_step=24.0,
        situations=16,
        start_together=together,
    )
    scenario = ScenarioConfig(
        agents=n_agents,
        region=region,
        motion=MOTIONS[motion],
        actions=ActionConfig(kind=kind, distances=[0.0, 20.0, 50.0, 90.0]),
        episode=EpisodeConfig(max_steps=15),
    )
    env = fresh(scenario, num_worlds=24)
    airspace = env.simulation.airspace
    assert airspace.max_points < 20
    generator = torch.Generator().manual_seed(0)
    moved = 0
    for _ in range(30):
        before = env.state
        act(env, random_actions(env, generator))
        goal = env.state.goal
        moved += int((goal != before.goal).sum())
        clash = goal.unsqueeze(-1) == goal.unsqueeze(-2)
        clash &= ~torch.eye(n_agents, dtype=torch.bool)
        if together:  # Two may share one point only as long as neither has left the start.
            stays = goal == before.goal
            both = stays.unsqueeze(-1) & stays.unsqueeze(-2)
            clash &= ~both
        assert not clash.any()
        assert (goal < airspace.n_points[0]).all()
        landed = env.simulation.landed(env.state)
        place = env.state.position[landed]
        assert place[..., :2].equal(env.simulation.points[goal[landed]])
        assert place[..., 2].abs().max(dim=0).values < 1e-5
        assert shapely.contains_xy(airspace.regions[0].polygon, place[..., :2].double()).all()
    assert moved > 24 * n_agents


def test_starts_are_different_points_or_one_or_those_given():
    apart = UavEnv(square(), num_worlds=64).reset()["agents", "message", "position"]
    assert (torch.cdist(apart, apart) + 1e9 * torch.eye(3)).min() > 1
    region = RegionConfig(kind="vertices", vertices=SQUARE, start_together=True)
    together = UavEnv(square(region=region), num_worlds=64).reset()
    place = together["agents", "message", "position"]
    assert torch.cdist(place, place).max() == 0
    assert len({tuple(p) for p in place[:, 0].tolist()}) > 10
    given = UavEnv(usecase(2)).reset()["agents", "message", "position"]
    expected = [pytest.approx([62.85586449, -119.2183645], abs=1e-4)] * 3
    assert given[0].tolist() == expected


# Choosing, flying, talking.


def test_the_action_of_a_uav_that_is_not_ready_changes_nothing():
    env = fresh(everything("polynomial"), num_worlds=32)
    generator = torch.Generator().manual_seed(0)
    waited = 0
    for _ in range(25):
        before = copy.deepcopy(env.state)
        ready = env.simulation.ready(before)
        action = random_actions(env, generator)
        after = act(env, action)
        state = copy.deepcopy(env.state)
        env.state = before
        other = torch.where(ready, action, random_actions(env, generator))
        assert same(act(env, other), after)
        check_equal(env.state, state)
        waited += int((~ready & (other != action)).sum())
        assert state.motions.le(before.motions + ready).all()
    assert waited > 100


def flight(env: UavEnv) -> float:
    """Duration of the flight that has just begun [s]."""
    return (2 * env.state.vertical + env.state.cruise).item()


@pytest.mark.parametrize("sensing", [0.0, 2.5])
def test_a_uav_is_ready_again_once_it_has_landed_and_sensed(sensing):
    motion = MotionConfig("polynomial", sensing_time=sensing)
    env = fresh(one_uav(motion=motion))
    assert env.reset()["agents", "ready"].all()
    shown = [go(env, EAST)]
    duration = flight(env)
    assert duration > 15
    shown += [go(env, EAST) for _ in range(math.ceil(duration + sensing) - 1)]
    for seconds, td in enumerate(shown, start=1):
        assert td["agents", "ready"].item() == (seconds >= duration + sensing)
        assert td["agents", "talks"].item() == (seconds >= duration)
    assert shown[-1]["agents", "ready"].item()


def test_in_flight_the_message_stays_the_last_one_and_its_time_does_too():
    env = fresh(one_uav(motion=FLYING))
    before = env.reset()["agents", "message"].clone()
    flown = go(env, EAST)
    duration, landing = flight(env), None
    for _ in range(math.ceil(duration) - 1):
        assert not flown["agents", "talks"].item()
        assert same(flown["agents", "message"], before)
        landing = flown = go(env, HERE)
    message = landing["agents", "message"]
    assert landing["agents", "talks"].item()
    assert message["time"].item() == math.ceil(duration)
    assert message["position"][0, 0].equal(env.simulation.points[env.state.goal.item()])
    assert message["position"].equal(message["target"])
    assert message["track"].item() == pytest.approx(math.pi / 2, abs=0.3)


def test_in_flight_nobody_listens():
    source = SourceConfig(level_db=130.0, position=[110.0, 100.0])  # On the way: 31.6 m are heard.
    loud = one_uav(motion=MotionConfig("polynomial"), source=source)
    loud.region.start_positions = [[20.0, 100.0]]
    loud.actions.distances = [0.0, 200.0]
    env = fresh(loud)
    go(env, EAST)
    near = False
    for _ in range(math.ceil(flight(env)) - 2):
        shown = go(env, HERE)
        away = torch.linalg.vector_norm(env.state.position[0, 0, :2] - env.state.source[0])
        near |= bool(away < 10)
        assert not shown["agents", "message", "spotted"].item()
    assert near
    assert env.state.motions.item() == 1  # As after a detection it would not be.


def test_a_hold_of_no_distance_keeps_the_point_and_counts_as_a_motion():
    env = fresh(one_uav())
    place = env.state.goal.clone()
    shown = go(env, HERE, HERE, HERE)
    assert env.state.goal.equal(place)
    assert shown["agents", "message", "motions"].item() == 3


def test_a_target_outside_the_region_holds():
    env = fresh(one_uav())
    place = env.state.goal.clone()
    go(env, WEST)
    assert env.state.goal.equal(place)
    go(env, EAST)
    assert not env.state.goal.equal(place)


def test_motions_count_from_the_latest_detection():
    env = fresh(one_uav(source=SourceConfig(level_db=130.0, position=[160.0, 100.0])))
    counted = []
    for action in (HERE, EAST, HERE, WEST, WEST, EAST):
        message = go(env, action)["agents", "message"]
        counted.append((message["spotted"].item(), message["motions"].item()))
    assert counted == [(False, 1), (True, 2), (True, 1), (False, 1), (False, 2), (True, 3)]


# Action masks.


@pytest.mark.parametrize("energy", [False, True])
def test_a_masked_action_holds_and_a_legal_one_that_leads_elsewhere_moves(energy):
    battery = BatteryConfig(enabled=energy, capacity_kwh=0.05)
    scenario = ScenarioConfig(
        agents=1,
        region=RegionConfig(min_area=20_000, max_area=50_000, pool=2, situations=8),
        battery=battery,
        episode=KEEPS_GOING,
    )
    n_actions = scenario.actions.n_actions
    env = fresh(scenario, num_worlds=n_actions)
    generator = torch.Generator().manual_seed(0)
    masked = reached = 0
    for _ in range(30):
        act(env, random_actions(env, generator))
        # World 0's situation everywhere; then each world tries another action.
        alike = [field[:1].expand_as(field).contiguous() for field in env.state[:-1]]
        level = 100 * torch.rand(1, generator=generator) if energy else torch.tensor([100.0])
        state = State(*alike, env.state.sent)._replace(battery=level.expand(n_actions, 1).clone())
        env.state = state
        legal = env.simulation.action_mask(state)[0, 0]
        act(env, torch.arange(n_actions)[:, None])
        moved = (env.state.goal != state.goal).squeeze(-1)
        assert not moved[~legal].any()
        nearest = env.simulation.candidates.distance[state.goal[0, 0]]
        assert moved[legal].equal(nearest[legal] > 0)
        masked, reached = masked + int((~legal).sum()), reached + int(moved.sum())
    assert masked > 100
    assert reached > 100


def test_in_flight_exactly_one_action_is_legal_and_it_holds():
    env = fresh(everything("polynomial"), num_worlds=16)
    generator = torch.Generator().manual_seed(0)
    waiting = 0
    for _ in range(20):
        shown = act(env, random_actions(env, generator))
        mask, ready = shown["agents", "action_mask"], shown["agents", "ready"]
        assert (mask[~ready].sum(-1) == 1).all()
        assert (mask[~ready].int().argmax(-1) == 0).all()
        assert mask.any(-1).all()
        waiting += int((~ready).sum())
    assert waiting > 50


def test_without_a_mask_none_is_shown():
    assert "action_mask" not in UavEnv(usecase(2)).reset()["agents"]
    assert "action_mask" in UavEnv(square()).reset()["agents"]


# Ends.


@pytest.mark.parametrize(("share", "needed"), [(0.3, 1), (0.5, 2), (1.0, 3)])
def test_success_needs_a_share_of_the_uavs_to_spot_at_once(share, needed):
    episode = EpisodeConfig(max_steps=None, success_share=share)
    env = fresh(square(source=SourceConfig(level_db=143.0), episode=episode), num_worlds=256)
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        shown = act(env, random_actions(env, generator))
        enough = shown["agents", "message", "spotted"].sum(-1, keepdim=True) >= needed
        assert enough.any()
        assert not enough.all()
        assert shown["success"].equal(enough)
        assert shown["terminated"].equal(enough)
        assert not shown["truncated"].any()


def test_the_time_limit_truncates_and_does_not_terminate():
    env = fresh(one_uav(episode=EpisodeConfig(max_steps=3)))
    ends = [go(env, HERE) for _ in range(3)]
    assert [td["truncated"].item() for td in ends] == [False, False, True]
    assert [td["done"].item() for td in ends] == [False, False, True]
    assert not any(td["terminated"].item() or td["success"].item() for td in ends)


def test_success_at_the_last_step_terminates_and_does_not_truncate():
    source = SourceConfig(level_db=130.0, position=[160.0, 100.0])
    episode = EpisodeConfig(max_steps=2, success_share=1.0)
    env = fresh(one_uav(source=source, episode=episode))
    shown = go(env, HERE, EAST)
    assert (shown["success"] & shown["terminated"] & ~shown["truncated"]).item()


def test_the_limit_can_count_from_the_latest_detection():
    source = SourceConfig(level_db=130.0, position=[60.0, 100.0])
    episode = EpisodeConfig(max_steps=3, since_detection=True)
    env = fresh(one_uav(source=source, episode=episode))
    assert not go(env, *[HERE] * 10)["done"].item()
    assert not go(env, EAST, EAST)["done"].item()
    assert go(env, HERE)["truncated"].item()
    unheard = fresh(one_uav(episode=episode))
    assert not go(unheard, HERE, HERE)["done"].item()
    assert go(unheard, HERE)["truncated"].item()


def test_empty_batteries_terminate_without_success():
    battery = BatteryConfig(enabled=True, capacity_kwh=0.02, charging_points=[[390.0, 10.0]])
    episode = EpisodeConfig(max_steps=None, discharged_share=1.0)
    task = RewardConfig(penalty=2.0)
    env = fresh(one_uav(battery=battery, episode=episode, task=task))
    env.state = env.state._replace(battery=torch.tensor([[1e-7]]))
    assert not go(env, HERE)["done"].item()
    env.state = env.state._replace(battery=torch.tensor([[0.0]]))
    shown = go(env, HERE)
    assert (shown["terminated"] & ~shown["truncated"] & ~shown["success"]).item()
    assert shown["agents", "reward"].item() == -2.0


def test_the_end_of_the_sources_walk_silences_it_and_terminates_if_wanted():
    source = walking(level_db=170.0, n_hotspots=1, min_stops=0, max_stops=0, min_wait=2.0, max_wait=2.0)
    for wanted in (True, False):
        episode = EpisodeConfig(max_steps=None, end_with_source=wanted)
        env = fresh(one_uav(source=source, episode=episode))
        shown = go(env, HERE)
        assert shown["agents", "message", "spotted"].item()
        assert not shown["done"].item()
        shown = go(env, HERE)
        assert shown["terminated"].item() == wanted
        assert not shown["agents", "message", "spotted"].item()


def test_a_persistent_task_never_ends():
    env = fresh(everything(episode=KEEPS_GOING), num_worlds=4)
    generator = torch.Generator().manual_seed(0)
    for _ in range(100):
        assert not act(env, random_actions(env, generator))["done"].any()


@pytest.mark.parametrize(("over_steps", "bonus"), [(False, 3.0), (True, 1.5)])
def test_success_pays_the_bonus_and_a_time_failure_costs_the_penalty(over_steps, bonus):
    source = SourceConfig(level_db=130.0, position=[160.0, 100.0])
    episode = EpisodeConfig(max_steps=3, success_share=1.0)
    task = RewardConfig(spotted=0.0, bonus=3.0, bonus_over_steps=over_steps, penalty=0.5)
    env = fresh(one_uav(source=source, episode=episode, task=task))
    assert go(env, HERE)["agents", "reward"].item() == 0.0
    assert go(env, EAST)["agents", "reward"].item() == bonus
    env.reset()
    assert go(env, HERE, HERE, HERE)["agents", "reward"].item() == -0.5


# Batteries.

FAR = [[390.0, 10.0]]


def test_a_flight_drains_what_it_should_whatever_the_step():
    drained, cost = [], None
    for period in ("1s", "0.5s", "0.25s"):
        battery = BatteryConfig(enabled=True, capacity_kwh=0.1, charging_points=FAR)
        env = fresh(one_uav(battery=battery, motion=MotionConfig("polynomial"), clock=clock(period)))
        go(env, EAST)
        origin, goal = (env.simulation.points[p.item()] for p in (env.state.origin, env.state.goal))
        length = torch.linalg.vector_norm(goal - origin)
        cost = flight_drain(env.state.vertical[0, 0], length, battery).item()
        duration = flight(env)
        levels = [env.state.battery.item()]
        while not env.simulation.landed(env.state).all():
            go(env, HERE)
            levels.append(env.state.battery.item())
        assert all(a >= b for a, b in itertools.pairwise(levels))
        assert len(levels) == math.ceil(duration / env.simulation.dt)
        go(env, HERE)
        drained.append(100 - env.state.battery.item())
    assert cost > 1
    assert drained == pytest.approx([cost] * 3, abs=1e-3)


def test_an_instant_flight_drains_as_much():
    battery = BatteryConfig(enabled=True, capacity_kwh=0.5)
    env = fresh(one_uav(battery=battery))
    origin = env.simulation.points[env.state.goal.item()]
    go(env, EAST)
    length = torch.linalg.vector_norm(env.simulation.points[env.state.goal.item()] - origin)
    cost = flight_drain(env.simulation.vertical[0], length, battery).item()
    assert env.state.battery.item() == pytest.approx(100 - cost, abs=1e-4)


@both_motions
def test_a_target_beyond_the_batterys_reach_is_not_flown_to(motion):
    battery = BatteryConfig(enabled=True, capacity_kwh=0.5, charging_points=FAR)
    env = fresh(one_uav(battery=battery, motion=MOTIONS[motion]))
    start = copy.deepcopy(env.state)
    go(env, EAST)
    length = torch.linalg.vector_norm(
        env.simulation.points[env.state.goal.item()] - env.simulation.points[start.goal.item()]
    )
    cost = flight_drain(env.simulation.vertical[0], length, battery)
    for factor, flies in ((0.99, False), (1.01, True)):
        env.state = start._replace(battery=factor * cost.view(1, 1))
        go(env, EAST)
        assert bool((env.state.goal != start.goal).item()) == flies


@both_motions
def test_an_empty_uav_stays_until_it_has_charged(motion):
    battery = BatteryConfig(enabled=True, capacity_kwh=0.05, charging_power_kw=0.5)
    env = fresh(one_uav(battery=battery, motion=MOTIONS[motion]))
    start = env.state.goal.item()
    env.state = env.state._replace(battery=torch.zeros(1, 1))
    gain = charge_gain(torch.tensor(1.0), battery).item()
    levels = []
    while env.state.goal.item() == start:
        levels.append(env.state.battery.item())
        go(env, EAST)
    assert len(levels) > 2
    assert levels == pytest.approx([gain * n for n in range(len(levels))], abs=1e-3)


def test_uavs_charge_only_at_charging_points():
    battery = BatteryConfig(enabled=True, capacity_kwh=0.5, charging_points=[[160.0, 100.0]])
    env = fresh(one_uav(battery=battery))
    env.state = env.state._replace(battery=torch.full((1, 1), 50.0))
    go(env, HERE, HERE)
    assert env.state.battery.item() == 50.0
    go(env, EAST)
    flown = env.state.battery.item()
    assert flown < 50.0
    go(env, HERE)
    gain = charge_gain(torch.tensor(1.0), battery).item()
    assert env.state.battery.item() == pytest.approx(flown + gain)


def test_a_uav_charges_from_the_step_after_its_landing_on():
    battery = BatteryConfig(enabled=True, capacity_kwh=0.1)
    env = fresh(one_uav(battery=battery, motion=FLYING))
    go(env, EAST)
    origin, goal = (env.simulation.points[p.item()] for p in (env.state.origin, env.state.goal))
    length = torch.linalg.vector_norm(goal - origin)
    cost = flight_drain(env.state.vertical[0, 0], length, battery).item()
    go(env, *[HERE] * (math.ceil(flight(env)) - 1))
    assert env.simulation.landed(env.state).all()
    assert env.state.battery.item() == pytest.approx(100 - cost, abs=1e-3)
    gain = charge_gain(torch.tensor(1.0), battery).item()
    go(env, HERE)
    assert env.state.battery.item() == pytest.approx(100 - cost + gain, abs=1e-3)


def test_a_battery_never_leaves_its_bounds():
    env = fresh(everything(episode=KEEPS_GOING), num_worlds=32)
    generator = torch.Generator().manual_seed(0)
    lowest = 100.0
    for _ in range(40):
        act(env, random_actions(env, generator))
        assert ((env.state.battery >= 0) & (env.state.battery <= 100)).all()
        lowest = min(lowest, env.state.battery.min().item())
    assert lowest < 95


# The source.


def test_an_intermittent_source_is_heard_as_often_as_it_emits():
    source = SourceConfig(
        level_db=160.0, position=[100.0, 100.0], emission="per_step", emission_probability=0.3
    )
    env = fresh(square(source=source, episode=KEEPS_GOING), num_worlds=400)
    heard = torch.stack(
        [act(env, torch.zeros(400, 3).long())["agents", "message", "spotted"].clone() for _ in range(25)]
    )
    assert heard.any(-1).equal(heard.all(-1))
    assert heard.float().mean().item() == pytest.approx(0.3, abs=0.02)
    # Neither worlds nor steps go together.
    assert 0 < heard[0, :, 0].float().mean() < 1
    assert 0 < heard[:, 0, 0].float().mean() < 1


def test_a_walking_source_moves_and_stays_inside():
    env = fresh(everything(), num_worlds=16)
    inside = env.simulation.airspace
    begun = env.state.source.clone()
    for _ in range(60):
        act(env, torch.zeros(16, env.n_agents).long())
        for place, region in zip(env.state.source, env.state.region, strict=True):
            polygon = inside.regions[region].polygon
            assert polygon.distance(shapely.Point(place.tolist())) < 1e-3
    assert (torch.linalg.vector_norm(env.state.source - begun, dim=-1) > 1).all()


# The slow twin.

TWIN_FEATURES = [name for name in GLOBAL if name != "coverage"]
SHOWN = [*TWIN_FEATURES, *LOCAL]


def twin_scenario(n_agents: int, kind: str, since: bool) -> ScenarioConfig:
    """Every term and feature but the coverage; odd distances, so that no two points tie."""
    task = dict.fromkeys((*INDIVIDUAL, *SYSTEM), 0.5) | {"coverage": 0.0}
    return ScenarioConfig(
        agents=n_agents,
        region=RegionConfig(min_area=15_000, max_area=60_000, pool=3, situations=24),
        source=SourceConfig(level_db=138.0),
        actions=ActionConfig(
            kind=kind,
            distances=[0.0, 33.3, 71.9, 118.4],
            headings=[-131.0, -77.7, -20.1, 11.3, 59.0, 123.4],
        ),
        observation=ObservationConfig(
            local_features=list(LOCAL), global_features=TWIN_FEATURES, time_scale=9.0
        ),
        task=RewardConfig(**task, bonus=2.0, bonus_over_steps=True, penalty=0.5),
        episode=EpisodeConfig(5, since_detection=since, success_share=None if since else 0.5),
        clock=clock("2s"),
    )


def twins(env: UavEnv) -> list[twin.World]:
    """The slow worlds that begin as the environment's do."""
    airspace, state, worlds = env.simulation.airspace, env.state, []
    for b, region in enumerate(state.region.tolist()):
        points = airspace.points[region, : airspace.n_points[region]].tolist()
        first = state.goal[b] - region * airspace.max_points
        world = twin.World(
            polygon=airspace.regions[region].polygon,
            points=points,
            source=tuple(state.source[b].tolist()),
            radius=10 ** ((138.0 - 105.0) / 20),
            scale=airspace.scale[region].item(),
            time_scale=9.0,
            dt=2.0,
            task=env.scenario.task,
            episode=env.scenario.episode,
            uavs=[twin.Uav(tuple(points[p]), p) for p in first.tolist()],
        )
        world.begin()
        worlds.append(world)
    return worlds


def check_shown(world: twin.World, seen: torch.Tensor):
    """The critic's observation [N, G] of one world."""
    columns = [
        np.array(values).reshape(len(world.uavs), -1) for values in (world.observe()[name] for name in SHOWN)
    ]
    apart = np.abs(np.concatenate(columns, 1) - seen.numpy())
    # Bearings and drifts are angles over a full turn: 0 is 1.
    widths = np.cumsum([0, *[c.shape[1] for c in columns]])
    for name in ("source_bearing", "source_drift"):
        k = widths[SHOWN.index(name)]
        apart[:, k] = np.minimum(apart[:, k], 1 - apart[:, k])
    assert apart.max() < 1e-4


@pytest.mark.parametrize("since", [False, True])
@both_kinds
@pytest.mark.parametrize("n_agents", [1, 2, 4])
def test_rollouts_equal_those_of_a_slow_twin(n_agents, kind, since):
    env = UavEnv(twin_scenario(n_agents, kind, since), num_worlds=12, seed=n_agents)
    table = env.scenario.actions.table()
    generator = torch.Generator().manual_seed(n_agents)
    compared = ended = spotted = 0
    for _ in range(3):
        shown = env.reset()
        worlds = twins(env)
        for b, world in enumerate(worlds):
            check_shown(world, shown["agents", "global_observation"][b])
        for _ in range(8):
            action = random_actions(env, generator)
            moves = table[action] if kind == "discrete" else action * torch.tensor([118.4, math.tau])
            shown = act(env, action)
            for b, world in enumerate(worlds):
                if any(world.ended):
                    continue
                rewards = world.step(moves[b].tolist())
                places = [list(uav.place) for uav in world.uavs]
                assert shown["agents", "message", "position"][b].tolist() == places
                check_shown(world, shown["agents", "global_observation"][b])
                ours = shown["agents", "reward"][b, :, 0].tolist()
                assert ours == pytest.approx(rewards, abs=1e-4)
                flags = [shown[k][b].item() for k in ("success", "terminated", "truncated")]
                assert tuple(flags) == world.ended
                spotted += sum(uav.spots for uav in world.uavs)
                ended += any(world.ended)
                compared += 1
    assert compared > 60
    assert ended > (0 if since else 20)
    assert spotted > 10


def test_the_coverage_counts_the_last_landing_points_within_a_hundredth():
    window = 3
    scenario = everything(
        observation=ObservationConfig(global_features=["coverage"], window=window),
        task=RewardConfig(spotted=0.0, coverage=1.0),
        episode=KEEPS_GOING,
    )
    env = fresh(scenario, num_worlds=3)
    generator = torch.Generator().manual_seed(0)
    radius = env.simulation.radius
    trails = env.state.position[..., :2].unsqueeze(2).expand(-1, -1, window, -1)
    for _ in range(5):
        shown = act(env, random_actions(env, generator))
        newest = env.state.position[..., :2].unsqueeze(2)
        trails = torch.cat([newest, trails[:, :, :-1]], 2)
        for b, region in enumerate(env.state.region.tolist()):
            polygon = env.simulation.airspace.regions[region].polygon
            expected = exact_coverage(polygon, trails[b].double().numpy(), radius)
            assert shown["agents", "reward"][b, :, 0].tolist() == pytest.approx(expected, abs=0.01)


def exact_coverage(polygon, trails, radius):
    """Shares of fresh footprints by shapely, UAV by UAV; the newest landing point comes first."""
    discs = [[shapely.Point(p).buffer(radius, quad_segs=64) for p in trail] for trail in trails]
    shares = []
    for i, own in enumerate(discs):
        areas = []
        for k, disc in enumerate(own):
            lost = [other[k] for j, other in enumerate(discs) if j != i] + own[k + 1 :]
            areas.append((disc & polygon).difference(shapely.union_all(lost)).area)
        shares.append(np.mean(areas) / (math.pi * radius**2))
    return shares


# Compiled.


@pytest.mark.slow
@pytest.mark.parametrize("scenario", [usecase(2), everything(), everything("polynomial", "continuous")])
def test_a_compiled_environment_gives_the_same_rollout(scenario):
    eager = UavEnv(scenario, num_worlds=4, seed=1)
    compiled = UavEnv(scenario, num_worlds=4, seed=1, compile=True)
    generator = torch.Generator().manual_seed(0)
    actions = [random_actions(eager, generator) for _ in range(30)]
    for one, other in zip(play(eager, actions), play(compiled, actions), strict=True):
        for key in one.keys(True, True):
            # Metres in flight: differences of float32 rounding at a hundred metres.
            near = 1e-4 if key == "state" else 1e-5
            torch.testing.assert_close(one[key], other[key], atol=near, rtol=1e-5)


@pytest.mark.parametrize("sensing_time", [0.0, 4.0])
def test_the_trail_takes_one_place_for_each_decision_however_long_the_uav_senses(sensing_time):
    scenario = everything("polynomial", episode=EpisodeConfig(max_steps=None))
    scenario.motion.sensing_time = sensing_time
    env = fresh(scenario, num_worlds=8)
    generator = torch.Generator().manual_seed(0)
    expected = env.state.sent.trail.tolist()
    due = torch.zeros(8, env.n_agents, dtype=torch.bool)
    landings = 0
    for _ in range(60):
        due |= env.simulation.ready(env.state)
        shown = act(env, random_actions(env, generator))
        for b, n in (due & shown["agents", "talks"]).nonzero().tolist():
            expected[b][n] = [env.state.goal[b, n].item(), *expected[b][n][:-1]]
            due[b, n] = False
            landings += 1
        assert env.state.sent.trail.tolist() == expected
    assert landings > 50


def test_a_uav_that_cannot_fly_there_keeps_nobody_else_from_a_point():
    actions = ActionConfig(kind="continuous")
    env = fresh(square(agents=2, battery=BatteryConfig(enabled=True), actions=actions))
    aim, *pair = (env.simulation.points - 100.0).norm(dim=-1).argsort()[:3].tolist()
    east, north = (env.simulation.points[aim] - env.simulation.points[pair]).unbind(-1)
    bearing = torch.atan2(east, north) / math.tau % 1
    action = torch.stack([torch.hypot(east, north) / max(actions.distances), bearing], -1)
    state, goal = env.state, torch.tensor([pair])
    for level, booked in ((100.0, [aim, None]), (0.0, [pair[0], aim])):
        battery = torch.tensor([[level, 100.0]])
        env.state = state._replace(goal=goal, origin=goal, battery=battery)
        act(env, action[None])
        first, second = env.state.goal[0].tolist()
        assert first == booked[0]
        assert (second == aim) == (booked[1] == aim)
