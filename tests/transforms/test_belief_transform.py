"""The transform ``Belief`` in an environment, and back-updated beliefs, against the slow twin."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from belief_twin import belief
from delayed_envs import PAPER
from helpers import square, walking
from torchrl.data import ReplayBuffer
from torchrl.envs import Compose, StepCounter, TransformedEnv

from damian import BackupdateStorage, DelayConfig, keys, make_env
from damian.envs.recompute import server_recompute
from damian.server.belief import build_source_grid, edge_of_cells
from damian.server.config import ObservationConfig
from damian.world.config import MotionConfig, RegionConfig
from damian.world.signal_source import footprint_radius

LONGEST = 7


def tracking(law=PAPER, own=False, **changed):
    """A moving, intermittent source in a small square."""
    return square(
        source=walking(emission="per_step", emission_probability=0.6, position=[100.0, 100.0]),
        observation=ObservationConfig(belief=["belief_gain"], own=own),
        delay=DelayConfig(obs=law, loss=0.1 if law else 0.0),
        **changed,
    )


def rollout(env, steps=10):
    """Steps [B, T] over the ends of several episodes."""
    return env.rollout(steps, break_when_any_done=False)


def episodes(data):
    """First and last step of each episode of one world [T]."""
    ends = data["next", "done"].flatten().nonzero().flatten().tolist()
    begins = [0, *(end + 1 for end in ends)]
    return [(a, b) for a, b in zip(begins, [*ends, len(data) - 1], strict=False) if a <= b]


def expected(env, data, begin, end, now, viewer=None):
    """The slow twin's beliefs after step ``end`` of an episode that begins at ``begin``, of one
    world [T].

    Each source is followed as if it were the only one, [K, C].
    """
    server = env.server
    found = []
    first = server.messages(data[keys.MESSAGE][begin])
    region = int(server.region_of(first))
    sent = server.messages(data["next", *keys.MESSAGE])
    flag = data["next", *keys.MESSAGE_SENT]
    delay = data.get(("next", *keys.DELAY), torch.where(flag, 0, -1).unsqueeze(-1)).squeeze(-1)
    for number, grid in enumerate(grids_of(env)):
        rows = rows_of(grid, sent, number).where(flag, grid.no_report)
        steps = [(rows[t].tolist(), delay[t].tolist()) for t in range(begin, end + 1)]
        first_rows = rows_of(grid, first, number).tolist()
        found.append(belief(grid, region, first_rows, steps, now - begin + 1, viewer))
    return torch.tensor(found)


@cache
def grids_of(env):
    """The tables of each source alone."""
    simulation = env.uav_env.simulation
    airspace = simulation.airspace
    radii = [footprint_radius(each) for each in simulation.sources]
    edge = edge_of_cells(airspace, min(radii))
    return [
        build_source_grid(airspace, each, radius, dt=1.0, edge=edge)
        for each, radius in zip(simulation.sources, radii, strict=True)
    ]


def rows_of(grid, messages, source):
    """Rows of what messages report of a source, [*, N]."""
    spots = messages.detected_time[..., source] == messages.time
    return torch.where(messages.in_flight, grid.no_report, 2 * messages.trail[..., 0] + spots)


def check(actual, wanted):
    torch.testing.assert_close(actual, wanted, rtol=2e-3, atol=1e-5)


SCENARIOS = {
    "no delay": tracking(0),
    "late": tracking(),
    "late, each UAV": tracking(own=True),
    "in flight": tracking(motion=MotionConfig(kind="polynomial"), own=True),
    "several sources": replace(
        tracking(own=True),
        source=walking(
            count=3,
            false_alarm=0.1,
            emission="per_step",
            each=[
                {},
                {"motion": "static", "level_db": 138.0},
                {"miss": 0.3, "emission": "constant"},
            ],
        ),
    ),
    "arrival": replace(tracking(), delay=DelayConfig(obs=PAPER, order="arrival")),
    "several regions": replace(
        tracking(own=True),
        region=RegionConfig(min_area=20_000, max_area=60_000, pool=3, initial_conditions=12),
        source=walking(emission="per_step", emission_probability=0.6),
    ),
}


@pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=SCENARIOS)
def test_a_belief_knows_what_has_arrived_and_nothing_else(scenario):
    env = make_env(scenario, 2, extras=["message"])
    data = rollout(env)
    for world in data:
        for begin, last in episodes(world):
            check(world[keys.BELIEF][begin], expected(env, world, begin, begin - 1, begin))
            for end in (begin, (begin + last) // 2, last):
                after = world["next"][end]
                check(after[keys.BELIEF], expected(env, world, begin, end, end))
                for uav in range(3 * scenario.observation.own):
                    check(after[keys.OWN_BELIEF][uav], expected(env, world, begin, end, end, uav))


@pytest.mark.parametrize("name", ["late", "several sources"])
def test_back_updated_beliefs_know_what_has_arrived_since(name):
    env = make_env(SCENARIOS[name], 2, extras=["message"])
    counted = TransformedEnv(env, Compose(StepCounter()))
    data = counted.rollout(27, break_when_any_done=False)
    recompute = server_recompute(env.server)
    storage = BackupdateStorage(1000, recompute, LONGEST)
    buffer = ReplayBuffer(storage=storage, batch_size=1)
    corrected = 0
    for part in data.split(9, 1):
        buffer.extend(part)
    stored = storage[storage.latest(data.shape[1])].transpose(0, 1)
    for world, raw in zip(stored, data, strict=True):
        for begin, last in episodes(raw):
            for end in range(begin, last + 1):
                # All that had been generated when the storage looked at the step last had arrived
                # by then.
                now = len(raw) - 1
                wanted = expected(env, raw, begin, end, now)
                check(world["next"][keys.BELIEF][end], wanted)
                corrected += not torch.allclose(raw["next"][keys.BELIEF][end], wanted, atol=1e-3)
                if end < last:
                    check(world[keys.BELIEF][end + 1], wanted)
    assert corrected > 3
