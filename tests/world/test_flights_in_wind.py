"""Wind, unequal UAVs and drawn settings, against plain loops over flights."""

import itertools
import math
from dataclasses import replace

import pytest
import torch
from helpers import DENTED, both_kinds, clock, play

from damian import DelayConfig, ScenarioConfig, UavEnv, make_env
from damian.common import counter_rng
from damian.common.errors import InputError
from damian.server.config import EpisodeConfig, ObservationConfig, RewardConfig
from damian.world.config import (
    ActionConfig,
    BatteryConfig,
    FailureConfig,
    MotionConfig,
    RegionConfig,
    RequestConfig,
    SourceConfig,
    WindConfig,
)

SPEED = [8.0, 12.0, 20.0]
HARDEST = [1.0, 2.0, 4.0]
LEAST = 2.0
WORLD = ScenarioConfig(
    agents=3,
    region=RegionConfig(kind="vertices", vertices=DENTED, lattice_step=50.0),
    motion=MotionConfig(
        kind="polynomial", max_speed=SPEED, max_acceleration=HARDEST, min_ground_speed=LEAST
    ),
    battery=BatteryConfig(enabled=True, capacity_kwh=[0.5, 1.0, 2.0]),
    actions=ActionConfig(distances=[0.0, 110.0, 230.0]),
    clock=clock("2s"),
)
STILL = replace(WORLD, motion=MotionConfig(), battery=BatteryConfig())


def through_the_air(way, wind, speed):
    """Way through the air [m] of a flight over places, and its lowest ground speed [m/s]."""
    total = 0.0
    slowest = math.inf
    for (x, y), (u, v) in itertools.pairwise(way):
        length = math.hypot(u - x, v - y)
        if length:
            along = (wind[0] * (u - x) + wind[1] * (v - y)) / length
            across = max(wind[0] ** 2 + wind[1] ** 2 - along**2, 0)
            ground = math.sqrt(max(speed**2 - across, 0)) + along
            slowest = min(slowest, ground)
            total += length * speed / max(ground, LEAST)
    return total, slowest


@pytest.mark.parametrize(
    "wind",
    [
        (7.0, 250.0),
        (15.0, 30.0),
    ],
)
def test_flights_in_wind_take_the_time_of_their_way_through_the_air(wind):
    speed, whence = wind
    env = UavEnv(replace(WORLD, wind=WindConfig(speed=speed, direction=whence)), 8, seed=1)
    blows = -speed * math.sin(math.radians(whence)), -speed * math.cos(math.radians(whence))
    env.set_seed(2)
    td = env.reset()
    flown = 0
    for _ in range(20):
        mask = td["agents", "action_mask"]
        stands = env.state
        nearest = env.simulation.candidates.nearest
        ready = env.simulation.vehicles.ready(stands)
        for world, uav in ready.nonzero().tolist():
            origin = stands.goal[world, uav]
            for action in range(0, mask.shape[-1], 5):
                goal = nearest[origin, action]
                outside = not env.simulation.candidates.distance[origin, action].isfinite()
                way = env.simulation.airspace.way(origin, goal).tolist()
                air, slowest = through_the_air(way, blows, SPEED[uav])
                drained = 100 * 10 / (12 * [0.5, 1.0, 2.0][uav])
                vertical = env.simulation.vehicles.vertical(stands)[uav].item()
                reach = (
                    (stands.battery[world, uav].item() - drained * 2 * vertical / 3240)
                    * 72000
                    / drained
                )
                good = not outside and (goal == origin or (slowest >= LEAST and air <= reach))
                assert mask[world, uav, action] == good, (world, uav, action)
        td = env.rand_step(td)["next"]
        after = env.state
        for world, uav in (ready & (after.goal != stands.goal)).nonzero().tolist():
            way = env.simulation.airspace.way(
                after.origin[world, uav], after.goal[world, uav]
            ).tolist()
            air, slowest = through_the_air(way, blows, SPEED[uav])
            assert slowest >= LEAST
            fast = 15 / 8 * air / SPEED[uav]
            hard = math.sqrt(10 * math.sqrt(3) / 3 * air / HARDEST[uav])
            assert after.cruise[world, uav].item() == pytest.approx(max(fast, hard), rel=1e-5)
            flown += 1
    assert flown > 20


def test_gusts_and_drawn_settings_of_a_world_do_not_depend_on_the_others():
    drawn = {
        "wind.speed": [0, 6],
        "motion.max_acceleration": [1, 2, 3],
        "source.miss": [0.0, 0.5],
    }
    flying = MotionConfig(kind="polynomial", abort=[0.2, 0.5, 1.0])
    gusty = WindConfig(gusts=2.0)
    fails = FailureConfig(0.05, 10.0)
    scenario = replace(WORLD, motion=flying, wind=gusty, failure=fails, randomise=drawn)
    together = UavEnv(scenario, 5, seed=0)
    alone = UavEnv(scenario, 1, seed=0)
    seeds = torch.arange(5) * 17
    together.seed_worlds(seeds)
    alone.seed_worlds(seeds[3:4])
    tds = [together.reset(), alone.reset()]
    seen = []
    for step in range(60):
        action = torch.randint(24, (5, 3), generator=torch.Generator().manual_seed(step))
        for index, (env, rows) in enumerate(((together, action), (alone, action[3:4]))):
            tds[index] = env.step_and_maybe_reset(tds[index].set(("agents", "action"), rows))[1]
        seen.append(together.state.drawn[3])
        for name, a, b in zip(together.state._fields, together.state, alone.state, strict=True):
            if name != "sent":
                assert a[3].equal(b[0]), name
    seen = torch.stack(seen)
    assert len(seen.unique(dim=0)) > 1, "each episode has its own"
    keys = [*drawn, "wind.direction"]
    for column, (low, high) in enumerate([(0, 6), (1, 3), (0, 0.5), (0, 360)]):
        assert ((seen[:, column] >= low) & (seen[:, column] <= high)).all(), keys[column]
    assert set(seen[:, 1].tolist()) <= {1.0, 2.0, 3.0}


@pytest.mark.parametrize(
    ("kind", "belief"),
    [
        ("instant", True),
        ("polynomial", False),
    ],
)
def test_worlds_with_a_drawn_level_are_those_of_this_level(kind, belief, monkeypatch):
    monkeypatch.setattr("damian.server.belief.MOST_CELLS", 8)  # of the same size for all levels
    levels = [138.0, 142.0, 145.0]
    flying = MotionConfig(kind=kind, max_speed=40.0, max_acceleration=20.0)
    base = replace(
        STILL,
        motion=flying,
        observation=ObservationConfig(
            global_features=["coverage", "source_distance", "coverage_map"],
            belief=["belief_gain", "belief_map"] * belief,
            own=True,
        ),
        delay=DelayConfig(obs=2 * belief),
        reward=RewardConfig(coverage=1.0, served=1.0),
        requests=RequestConfig(rate=30.0),
        episode=EpisodeConfig(15),
    )
    scenarios = [replace(base, source=replace(base.source, level_db=level)) for level in levels]
    envs = [make_env(replace(base, randomise={"source.level_db": levels}), 8)]
    envs += [make_env(scenario, 8) for scenario in scenarios]
    for env in envs:
        env.set_seed(1)
    tds = [env.reset() for env in envs]
    met = set()
    for step in range(30):
        action = torch.randint(24, (8, 3), generator=torch.Generator().manual_seed(step))
        steps = []
        for i, env in enumerate(envs):
            before, tds[i] = env.step_and_maybe_reset(tds[i].set(("agents", "action"), action))
            steps.append(before["next"])
        if step % 15 == 14:  # these outputs belong to an episode whose level is gone
            continue
        for world, level in enumerate(envs[0].uav_env.state.drawn[:, 0].tolist()):
            one = steps[1 + levels.index(level)]["agents"][world]
            met.add(level)
            for name in ("observation", "reward"):
                torch.testing.assert_close(
                    steps[0]["agents", name][world], one[name], rtol=0, atol=3e-3
                )
    assert met == {*levels}


def test_what_has_tables_for_each_level_refuses_a_range_of_them():
    seen = ObservationConfig(belief=["belief_map"])
    drawn = {"source.level_db": [138, 142]}
    with pytest.raises(InputError, match=r"source.level_db: .* is a range, .* give a list"):
        make_env(replace(STILL, observation=seen, randomise=drawn))


def test_messages_with_a_drawn_loss_are_lost_as_with_this_loss():
    losses = [0.0, 0.3, 0.9]
    law = {
        "law": "lag",
        "lag": "1..4",
    }
    scenarios = [
        replace(
            STILL,
            delay=DelayConfig(law),
            randomise={"delay.loss": losses},
        )
    ]
    scenarios += [replace(STILL, delay=DelayConfig(law, loss=loss)) for loss in losses]
    envs = [make_env(each, 12, 0, extras=["message"]) for each in scenarios]
    actions = [*torch.randint(24, (60, 12, 3))]
    flown = [torch.stack(play(env, actions)[1::2], 1) for env in envs]
    drawn = flown[0]["agents", "loss"][..., 0, 0]
    assert len(drawn.unique()) == 3
    for loss, one in zip(losses, flown[1:], strict=True):
        chosen = drawn == torch.tensor(loss)
        for name in ("delay", "received", "age"):
            assert flown[0]["agents", name][chosen].equal(one["agents", name][chosen])


def test_reports_of_two_sources_are_those_of_a_plain_loop():
    each = [
        {
            "level_db": 150.0,
            "miss": 0.4,
            "false_alarm": 0.1,
        },
        {"level_db": 145.0, "miss": 0.2},
    ]
    moving = replace(WORLD.motion, max_speed=60.0, max_acceleration=40.0)
    scenario = replace(
        WORLD,
        motion=moving,
        source=SourceConfig(count=2, each=each),
    )
    scenario = replace(scenario, episode=EpisodeConfig(None, all_sources=True))
    env = UavEnv(scenario, 8, seed=0)
    tag = torch.tensor(counter_rng.number_of("report"))
    td = env.reset()
    missed = 0
    alarms = 0
    successes = 0
    heard = [[[-1.0, -1.0] for _ in range(3)] for _ in range(8)]
    for t in range(31):
        state = env.state
        ground = env.simulation.vehicles.on_ground(state)
        counters = (state.seed, tag.expand(8), state.episode, state.steps)
        counters = [each.view(8, 1, 1) for each in counters]
        shares = counter_rng.uniform(*counters, torch.arange(6).view(3, 2)).tolist()
        for b, n, k in itertools.product(range(8), range(3), range(2)):
            share = shares[b][n][k]
            way = math.dist(state.position[b, n, :2].tolist(), state.source[b, k].tolist())
            near = way <= 10 ** ((each[k]["level_db"] - 105) / 20)
            reports = share >= each[k]["miss"] if near else share < each[k].get("false_alarm", 0)
            missed += bool(ground[b, n] and near and not reports)
            alarms += bool(ground[b, n] and not near and reports)
            if ground[b, n] and reports:
                heard[b][n][k] = 2.0 * t
                at = state.sent.detected_position[b, n, k]
                assert at.equal(state.position[b, n, :2])
        assert state.sent.detected_time.tolist() == heard
        spotted = torch.tensor(heard) == state.sent.time.unsqueeze(-1)
        assert state.sent.spotted.equal(spotted.any(-1))
        if t:
            assert td["success"][:, 0].equal(spotted.any(1).all(-1))
            successes += int(td["success"].sum())
        td = env.step(env.rand_action(td))["next"]
    assert min(missed, alarms, successes) > 5


@pytest.mark.parametrize(
    "ends", [{"success_share": 0.6}, {"all_sources": True, "since_detection": True}]
)
def test_the_truth_pays_and_ends_as_if_there_were_no_misses_and_false_alarms(ends):
    reward = RewardConfig(
        spotted=1.0, spotting_agents=1.0, source_distance=0.5, bonus=7.0, penalty=3.0
    )
    source = SourceConfig(count=2, level_db=150.0)
    episode = EpisodeConfig(12, **ends)
    clear = replace(STILL, reward=reward, source=source, episode=episode)
    reported = replace(
        clear,
        source=replace(
            clear.source,
            miss=0.5,
            false_alarm=0.2,
        ),
    )
    judged = replace(reported, reward=replace(clear.reward, detection="truth"))
    rewards = []
    for scenario in (clear, judged, reported):
        env = UavEnv(scenario, 16, seed=0)
        env.set_seed(1)
        td = env.reset()
        found = []
        for step in range(20):
            action = torch.randint(24, (16, 3), generator=torch.Generator().manual_seed(step))
            td = env.step(td.set(("agents", "action"), action))["next"]
            decided = [td[name].float() for name in ("success", "terminated", "truncated")]
            found.append(torch.cat([td["agents", "reward"].squeeze(-1), *decided], -1))
        rewards.append(torch.stack(found))
    assert rewards[1].equal(rewards[0])
    assert (rewards[2] != rewards[0]).flatten(0, 1).any(0).all()
    assert rewards[0][..., -3:].flatten(0, 1).any(0).all()


@both_kinds
def test_a_battery_is_empty_where_it_allows_no_flight_in_this_wind(kind):
    windy = replace(
        WORLD,
        motion=replace(WORLD.motion, max_speed=10.0, max_acceleration=4.0),
        wind=WindConfig(speed=7.0, direction=0.0),
        battery=BatteryConfig(enabled=True, capacity_kwh=0.01, charging_power_kw=1e-6),
        actions=ActionConfig(kind, distances=[0.0, 60.0, 120.0]),
    )
    env = UavEnv(windy, 64, seed=1)
    env.reset()
    levels = torch.linspace(5, 45, 64).unsqueeze(-1).repeat(1, 3)
    env.state = env.state._replace(battery=levels, battery_before=levels.clone())
    td = env.rand_action()
    td["agents", "action"] = torch.zeros_like(td["agents", "action"])  # all hold
    td = env.step(td)["next"]
    state = env.state
    points = env.simulation.points.tolist()
    reach = env.simulation.vehicles.battery_reach(state)
    counts = [0, 0]
    for b, n in itertools.product(range(64), range(3)):
        at = points[state.goal[b, n]]
        if kind == "discrete":
            goals = [points[p] for p in env.simulation.candidates.nearest[state.goal[b, n]]]
        else:
            goals = [p for p in points if math.dist(p, at) < 2 * 120]
        ways = [through_the_air([at, goal], (0.0, -7.0), 10.0)[0] for goal in goals if goal != at]
        stuck = reach[b, n] < min(ways) or state.battery[b, n] < 5
        assert state.sent.empty[b, n].item() == stuck
        counts[stuck] += 1
    assert min(counts) > 20


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"motion": MotionConfig("polynomial", max_speed=[1.0, 2.0])},
            "motion.max_speed: .* each of the 3",
        ),
        (
            {"motion": MotionConfig(), "wind": WindConfig(speed=3.0)},
            "wind: .* needs motion=polynomial",
        ),
        (
            {"randomise": {"agents": [1, 2]}},
            "randomise.agents: .* cannot be drawn, only motion.max_speed",
        ),
        ({"randomise": {"wind.speed": 3}}, "randomise.wind.speed: 3 is not a range"),
        (
            {"randomise": {"motion.max_speed": [5, 9]}},
            "randomise.motion.max_speed: .* one for each: leave one",
        ),
    ],
)
def test_values_that_cannot_be_are_refused(changed, message):
    with pytest.raises(InputError, match=message):
        replace(WORLD, **changed)
