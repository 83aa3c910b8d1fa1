"""Requests against a plain loop over worlds, slots and UAVs."""

import itertools
import math

import pytest
import torch

from damian.baselines.script import script_policy
from damian.common import counter_rng
from damian.common.errors import InputError
from damian.delays.config import DelayConfig
from damian.envs.config import ScenarioConfig
from damian.envs.pipeline import make_env
from damian.envs.uav_env import UavEnv
from damian.server.config import EpisodeConfig, ObservationConfig, RewardConfig
from damian.world.config import MotionConfig, RegionConfig, RequestConfig, SourceConfig

RATE, MOST = 40.0, 3


def scenario(**changed) -> ScenarioConfig:
    settings = {
        "region": RegionConfig(kind="vertices", vertices=[[0, 0], [400, 0], [400, 300], [0, 300]]),
        "source": SourceConfig(level_db=138.0),
        "requests": RequestConfig(rate=RATE, most=MOST),
        "observation": ObservationConfig(local_features=["served"], global_features=["others", "requests"]),
        "reward": RewardConfig(spotted=0.0, served=1.0),
        "episode": EpisodeConfig(40),
    }
    return ScenarioConfig(agents=3, **settings | changed)


@pytest.mark.parametrize("kind", ["instant", "polynomial"])
def test_requests_appear_and_are_served_as_in_a_plain_loop(kind):
    env = UavEnv(scenario(motion=MotionConfig(kind=kind, max_speed=40.0, max_acceleration=20.0)), 6, seed=2)
    env.set_seed(5)
    td, radius, served_ever, lost = env.reset(), env.simulation.radius, 0, 0
    slots = [[(*row,) for row in world] for world in env.state.requests.tolist()]
    memory = env.state.sent.served.tolist()
    for _ in range(60):
        before = env.state
        td = env.step_and_maybe_reset(env.rand_action(td))[1]
        state = env.state
        lands = env.simulation.vehicles.new_stop(state, env.simulation.vehicles.on_ground(state), None)
        for b in range(6):
            if state.steps[b] == 0:
                slots[b] = [(*row,) for row in state.requests[b].tolist()]
                memory[b] = state.sent.served[b].tolist()
                continue
            tag = torch.tensor(counter_rng.number_of("request appears"))
            share = counter_rng.uniform(state.seed[b], tag, state.episode[b], state.steps[b]).item()
            if share < 1 - math.exp(-RATE / 60):
                free = [m for m in range(MOST) if slots[b][m][2] <= max(row[m] for row in memory[b])]
                lost += not free
                if free:
                    oldest = min(free, key=lambda m: slots[b][m][2])
                    slots[b][oldest] = (*state.requests[b, oldest, :2].tolist(), float(state.steps[b]))
            taken, was = set(), [max(row[m] for row in memory[b]) for m in range(MOST)]
            for n in range(3):
                at = state.position[b, n, :2].tolist()
                near = [
                    m
                    for m in range(MOST)
                    if slots[b][m][2] >= 0
                    and slots[b][m][2] > was[m]
                    and math.dist(slots[b][m][:2], at) <= radius
                ]
                best = min(near, key=lambda m: slots[b][m][2], default=None)
                serves = (lands is None or bool(lands[b, n])) and best is not None and best not in taken
                if serves:
                    taken.add(best)
                    memory[b][n][best] = slots[b][best][2]
                    served_ever += 1
                if state.message_sent[b, n]:
                    assert state.sent.serves[b, n].item() == serves
            assert state.requests[b].tolist() == [list(row) for row in slots[b]]
            for n in range(3):
                if state.message_sent[b, n]:
                    assert state.sent.served[b, n].tolist() == memory[b][n]
        assert before.seed.equal(state.seed)
    assert served_ever > 10
    assert lost > 0


def test_with_a_range_uavs_know_what_they_have_heard_on_the_ground():
    flying, reach = MotionConfig(kind="polynomial", max_speed=40.0, max_acceleration=20.0), 120.0
    env = UavEnv(scenario(motion=flying, requests=RequestConfig(RATE, MOST, range=reach)), 6, seed=2)
    td, heard = env.reset(), 0
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
    env = UavEnv(scenario(requests=RequestConfig(rate=12.0, most=64)), 64, seed=0)
    env.reset()
    for _ in range(39):
        env.rand_step()
    appeared = env.state.requests[env.state.requests[..., 2] >= 0]
    expected = 64 * 39 * (1 - math.exp(-12 / 60))
    assert abs(len(appeared) - expected) < 4 * math.sqrt(expected)
    for places, high in ((appeared[:, 0], 400), (appeared[:, 1], 300)):
        share = (places + high / 2) / high
        assert abs(share.mean() - 0.5) < 4 * math.sqrt(1 / 12 / len(share))


def test_the_server_knows_of_service_only_what_has_arrived():
    env = make_env(scenario(delay=DelayConfig(obs=4)), 32, 0, "cpu", ["message", "state"])
    rollout = env.rollout(30, break_when_any_done=False)
    server = env.uav_env.server
    held, sent = (server.messages(rollout["agents", name]) for name in ("received", "message"))
    assert held.served[:, 10:].equal(sent.served[:, 6:-4])
    seen = rollout["agents", "global_observation"][..., 20:36].unflatten(-1, (4, 4))
    assert seen[..., 3].sum() > 0
    assert (seen[..., 3] <= (held.requests[..., 2].amax(-2) >= 0).sum(-1)[..., None, None]).all()


@pytest.mark.parametrize("reach", [None, 100.0])
def test_the_dispatcher_serves_more_than_chance(reach):
    asked = scenario(requests=RequestConfig(RATE, MOST, range=reach))
    env = make_env(asked, 64, 0, "cpu", ["message", "state"])
    returns = []
    for policy in (script_policy(env), None):
        env.set_seed(0)
        returns.append(
            env.rollout(40, policy, break_when_any_done=False)["next", "agents", "reward"].sum(1).mean()
        )
    assert returns[0] > 1.5 * returns[1]


def test_what_needs_requests_is_refused_without_them():
    with pytest.raises(InputError, match=r"requests.rate: 0 is 0, so that no request appears|requests.rate"):
        scenario(requests=RequestConfig())
