"""Requests against a plain loop over worlds, slots and UAVs."""

import itertools
import math

import pytest
import torch
from helpers import corners

from damian import ClockConfig, DelayConfig, ScenarioConfig, UavEnv, make_env
from damian.baselines.script import script_policy
from damian.common import counter_rng
from damian.common.errors import InputError
from damian.server.config import EpisodeConfig, ObservationConfig, RewardConfig
from damian.world.config import MotionConfig, RegionConfig, RequestConfig, SourceConfig

RATE = 40.0
MOST = 3


def scenario(**changed):
    settings = {
        "region": RegionConfig(kind="vertices", vertices=corners(0, 0, 400, 300)),
        "source": SourceConfig(level_db=138.0),
        "requests": RequestConfig(rate=RATE, most=MOST),
        "observation": ObservationConfig(
            local_features=["served"], global_features=["others", "requests"]
        ),
        "reward": RewardConfig(spotted=0.0, served=1.0),
        "episode": EpisodeConfig(40),
    }
    return ScenarioConfig(agents=3, **settings | changed)


@pytest.mark.parametrize(
    ("kind", "dt"),
    [
        ("instant", 1),
        ("polynomial", 1),
        ("instant", 5),
    ],
)
def test_requests_appear_are_known_and_served_as_in_a_plain_loop(kind, dt):
    motion = MotionConfig(kind=kind, max_speed=40.0, max_acceleration=20.0)
    env = UavEnv(scenario(motion=motion, clock=ClockConfig(f"{dt}s")), 6, seed=2)
    env.set_seed(5)
    mean = RATE * dt / 60
    several = 0
    none_of = [math.exp(-mean) * mean**k / math.factorial(k) for k in range(MOST)]
    at_least = [1 - math.fsum(none_of[:k]) for k in range(1, MOST + 1)]
    tag = torch.tensor(counter_rng.number_of("request appears"))
    td = env.reset()
    radius = env.simulation.radius
    served_ever = 0
    lost = 0
    slots = [[(*row,) for row in world] for world in env.state.requests.tolist()]
    memory = env.state.sent.served.tolist()
    for _ in range(60):
        after, td = env.step_and_maybe_reset(env.rand_action(td))
        state = env.state
        rewards = after["next", "agents", "reward"]
        shares = counter_rng.uniform(state.seed, tag.expand(6), state.episode, state.steps).tolist()
        lands = env.simulation.vehicles.new_stop(
            state, env.simulation.vehicles.on_ground(state), None
        )
        for b in range(6):
            if state.steps[b] == 0:
                slots[b] = [(*row,) for row in state.requests[b].tolist()]
                memory[b] = state.sent.served[b].tolist()
                assert (state.requests[b, :, 2] == -1).all()
                continue
            number = sum(shares[b] < chance for chance in at_least)
            free = [m for m in range(MOST) if slots[b][m][2] <= max(row[m] for row in memory[b])]
            lost += max(number - len(free), 0)
            several += min(number, len(free)) > 1
            for m in sorted(free, key=lambda m: slots[b][m][2])[:number]:
                slots[b][m] = (*state.requests[b, m, :2].tolist(), float(state.steps[b] * dt))
            taken = set()
            was = [max(row[m] for row in memory[b]) for m in range(MOST)]
            for n in range(3):
                at = state.position[b, n, :2].tolist()
                near = [
                    m
                    for m in range(MOST)
                    if slots[b][m][2] >= 0
                    and slots[b][m][2] > was[m]
                    and math.dist(slots[b][m][:2], at) <= radius
                ]
                best = min(
                    near,
                    key=lambda m: slots[b][m][2],
                    default=None,
                )
                serves = (
                    (lands is None or bool(lands[b, n])) and best is not None and best not in taken
                )
                if serves:
                    taken.add(best)
                    memory[b][n][best] = slots[b][best][2]
                    served_ever += 1
                assert rewards[b, n].item() == serves
                if state.message_sent[b, n]:
                    assert state.sent.serves[b, n].item() == serves
            assert state.requests[b].tolist() == [list(row) for row in slots[b]]
            for n in range(3):
                assert state.sent.requests[b, n].equal(state.requests[b])
                if state.message_sent[b, n]:
                    assert state.sent.served[b, n].tolist() == memory[b][n]
    assert served_ever > 10
    assert lost > 0
    assert several > 0


def test_with_a_range_uavs_know_what_they_have_heard_on_the_ground():
    flying = MotionConfig(kind="polynomial", max_speed=40.0, max_acceleration=20.0)
    reach = 120.0
    env = UavEnv(
        scenario(motion=flying, requests=RequestConfig(RATE, MOST, range=reach)), 6, seed=2
    )
    td = env.reset()
    heard = 0
    known = torch.full((6, 3, MOST, 3), -1.0).tolist()
    for _ in range(40):
        state = env.state
        ground = env.simulation.vehicles.on_ground(state)
        for b, n, m in itertools.product(range(6), range(3), range(MOST)):
            request = state.requests[b, m].tolist()
            if ground[b, n] and math.dist(request[:2], state.position[b, n, :2].tolist()) <= reach:
                heard += known[b][n][m] != request
                known[b][n][m] = request
        assert state.sent.requests.tolist() == known
        td = env.step(env.rand_action(td))["next"]
    assert heard > 20


def test_requests_appear_at_their_rate_anywhere_in_the_region():
    env = UavEnv(scenario(requests=RequestConfig(60.0, most=64), clock=ClockConfig("5s")), 64)
    env.reset()
    for _ in range(7):
        env.rand_step()
    appeared = env.state.requests[env.state.requests[..., 2] >= 0]
    expected = 64 * 7 * 5
    assert abs(len(appeared) - expected) < 4 * math.sqrt(expected)
    for places, high in ((appeared[:, 0], 400), (appeared[:, 1], 300)):
        share = (places + high / 2) / high
        assert abs(share.mean() - 0.5) < 4 * math.sqrt(1 / 12 / len(share))


@pytest.mark.parametrize("reach", [None, 150.0])
def test_late_messages_show_requests_and_pay_services_as_in_a_plain_loop(reach):
    flying = MotionConfig(kind="polynomial", max_speed=60.0, max_acceleration=40.0)
    late = DelayConfig(
        obs="0..4",
        loss=0.4,
    )
    asked = scenario(
        motion=flying,
        delay=late,
        requests=RequestConfig(RATE, 6, range=reach),
    )
    env = make_env(asked, 4, 0, extras=["message"])
    steps = env.rollout(39, break_when_any_done=False)["next", "agents"]
    server = env.uav_env.server
    shown = 0
    overtaken = 0
    paid = 0
    served = 0
    held, sent = (server.messages(steps[name]) for name in ("received", "message"))
    half = server.scales(held)[0, 0].item() / 2
    seen = steps["global_observation"][..., 20:36].unflatten(-1, (4, 4))
    assert held.requests.equal(sent.requests) == (reach is None)
    for b in range(4):
        before = [0.0] * 3
        for t in range(39):
            now = [field[b, t].tolist() for field in (held.time, held.serves, held.target)]
            known = held.requests[b, t].tolist()
            done = held.served[b, t].tolist()
            newest = [
                max((row[m] for row in known), key=lambda request: request[2]) for m in range(6)
            ]
            last = [max(row[m] for row in done) for m in range(6)]
            overtaken += any(row[m] != newest[m] for row in known for m in range(6))
            opened = [x for x, when in zip(newest, last, strict=True) if x[2] > max(when, -0.5)]
            for n, (time, serves, target) in enumerate(zip(*now, strict=True)):
                pays = serves == [1.0] and time != before[n]
                assert steps["reward"][b, t, n].item() == pays
                rows = []
                for east, north, when in sorted(opened, key=lambda x: math.dist(x[:2], target))[:4]:
                    way = [(east - target[0]) / half, (north - target[1]) / half]
                    rows.append([*(min(max(x, -1), 1) for x in way), (t + 1 - when) / 40, 1.0])
                shown += len(rows)
                rows += [[0.0] * 4] * (4 - len(rows))
                torch.testing.assert_close(
                    seen[b, t, n],
                    torch.tensor(rows),
                    rtol=0,
                    atol=1e-5,
                )
                paid, before[n] = paid + pays, time
                served += int(sent.serves[b, t, n, 0] * steps["message_sent"][b, t, n])
    assert 5 < paid < served
    assert shown > 100
    assert (overtaken > 100) == (reach is not None)


@pytest.mark.parametrize("reach", [None, 100.0])
def test_the_dispatcher_serves_more_than_chance(reach):
    asked = scenario(requests=RequestConfig(RATE, MOST, range=reach))
    env = make_env(asked, 32, 0, "cpu", ["message", "state"])
    returns = []
    for policy in (script_policy(env), None):
        env.set_seed(0)
        returns.append(
            env.rollout(40, policy, break_when_any_done=False)["next", "agents", "reward"]
            .sum(1)
            .mean()
        )
    assert returns[0] > 1.5 * returns[1]


def test_what_needs_requests_is_refused_without_them():
    with pytest.raises(
        InputError, match=r"requests.rate: 0 is 0, so that no request appears|requests.rate"
    ):
        scenario(requests=RequestConfig())
