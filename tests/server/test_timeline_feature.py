"""The features ``timeline`` and ``events``: slot k is where a UAV stood k steps ago, and what it
heard and served there, as far as that has arrived by now."""

import itertools

import pytest
import torch

from damian import ScenarioConfig, keys, make_env
from damian.common.errors import InputError
from damian.delays.config import DelayConfig, LinkConfig
from damian.server.config import EpisodeConfig, ObservationConfig, RewardConfig
from damian.world.config import RegionConfig, RequestConfig, SourceConfig

SLOTS = 4
AGENTS = 3
UNIFORM = "0..6"
QUIET = RequestConfig(rate=0.0)
CASES = {
    "no delay": {},
    "delays beyond the slots, losses": {"delay": DelayConfig(obs=UNIFORM, loss=0.2)},
    "held back": {
        "delay": DelayConfig(
            obs="0..2",
            hold="max",
        )
    },
    "links": {"links": LinkConfig("matrix", delay=UNIFORM, loss=0.2)},
}


def scenario(own=True, stops=None, **changed):
    """UAVs that move at once and observe their own places and the timeline, in short episodes."""
    sections = {
        "agents": AGENTS,
        "region": RegionConfig(kind="random", pool=2, lattice_step=60.0),
        "observation": ObservationConfig(
            ["place"], ["events"], own=own, window=1, timeline=SLOTS, stops=stops
        ),
        "episode": EpisodeConfig(max_steps=9),
        "requests": RequestConfig(rate=30.0, most=4),
        "source": SourceConfig(level_db=146.0),
    }
    return ScenarioConfig(**(sections | changed))


@pytest.mark.sample(2)
@pytest.mark.parametrize("stops", [1, None])
@pytest.mark.parametrize(("name", "own"), [*((name, True) for name in CASES), ("held back", False)])
def test_a_slot_tells_where_a_uav_stood_then_if_a_message_that_tells_it_has_arrived(
    name, own, stops
):
    case = scenario(own and name != "links", stops, **CASES[name])
    env = make_env(case, 4, seed=1, extras=["message"])
    for drop in env.transform:
        drop.dropped_keys = []
    torch.manual_seed(0)
    steps = env.rollout(25, break_when_any_done=False)
    server = env.server
    after = steps["next"]
    seen = 0
    delay = after.get(keys.LINK_DELAY if name == "links" else keys.DELAY, None)
    delay = torch.zeros(4, 25, AGENTS, 1) if delay is None else delay
    if name != "links":  # by receiver and sender
        delay = delay.transpose(-1, -2).repeat(1, 1, AGENTS, 1)
        delay = delay.masked_fill(torch.eye(AGENTS, dtype=torch.bool) & own, 0)
    sent = server.messages(after[keys.MESSAGE])
    first = server.messages(steps[keys.MESSAGE])
    happened, happened_first = (
        torch.cat([each.spots.float(), each.serves], -1) for each in (sent, first)
    )
    half = server.scales(sent) / 2
    blocks = env.layout["observation"]
    observed, events = (
        blocks[name].of(after[keys.OBSERVATION]).flatten(-2) for name in ("timeline", "events")
    )
    assert blocks["events"].entries == ("heard source 1", "served")
    assert happened.mean((0, 1, 2)).gt(0.05).all()
    for world, t, i in itertools.product(range(4), range(25), range(AGENTS)):
        ended = after[keys.DONE][world, :t].flatten().nonzero()
        begin = int(ended[-1]) + 1 if len(ended) else 0
        places = [
            first.position[world, begin],
            *sent.position[world, begin : t + 1],
        ]  # in this episode
        events_then = [happened_first[world, begin], *happened[world, begin : t + 1]]
        now = len(places) - 1
        targets = []
        rows = torch.zeros(AGENTS, SLOTS + 1, 3)
        told_events = torch.zeros(AGENTS, SLOTS, 2)
        for j in range(AGENTS):
            arrived = [0]  # the message of the reset
            for g in range(1, now + 1):
                d = int(delay[world, begin + g - 1, i, j])
                arrived += [g] * (0 <= d <= now - g)
            targets.append(places[max(arrived)][j])
            for told in {g - older for g in arrived for older in range(min(stops or SLOTS, g + 1))}:
                if now - told < SLOTS:
                    rows[j, now - told] = torch.tensor([*places[told][j], 1.0])
                    told_events[j, now - told] = events_then[told][j]
                    seen += 1
        rows[..., :2] = (rows[..., :2] - targets[i]) / half[world, t] * rows[..., 2:]
        expected = sorted(
            (
                float((targets[j] - targets[i]).norm()),
                rows[j].clamp(-1, 1).flatten().tolist(),
                told_events[j].flatten().tolist(),
            )
            for j in range(AGENTS)
            if j != i
        )
        assert not observed[world, t, i, AGENTS - 1 :].any()
        if expected[1][0] - expected[0][0] > 1e-2:  # else in any order
            _, values, then = map(torch.tensor, zip(*expected, strict=True))
            assert observed[world, t, i, : AGENTS - 1].allclose(values, atol=1e-5), (world, t, i)
            assert events[world, t, i, : AGENTS - 1].equal(then), (world, t, i)
    assert seen > 500


def test_a_timeline_needs_the_order_of_generation():
    with pytest.raises(
        InputError, match=r"observation\.timeline: 4 does not go with delay\.order=arrival"
    ):
        scenario(delay=DelayConfig(obs=2, order="arrival"))


def test_events_need_a_timeline_and_something_that_happens():
    for changed in ({"observation": ObservationConfig([], ["events"])}, {"requests": QUIET}):
        with pytest.raises(InputError, match=r"has events, which need observation\.timeline"):
            scenario(reward=RewardConfig(coverage=1.0, spotted=0.0), **changed)


def test_stops_are_those_of_the_newest_messages_with_how_long_ago_they_were():
    n_stops = 5
    observation = ObservationConfig(["place"], ["stops"], window=1, stops=n_stops)
    case = scenario(observation=observation, delay=DelayConfig(obs=3))
    env = make_env(case, 4, seed=1, extras=["message"])
    torch.manual_seed(0)
    steps = env.rollout(20, break_when_any_done=False)
    simulation = env.uav_env.simulation
    points = simulation.airspace.points.flatten(0, 1)
    after = steps["next"]
    stops = env.layout["observation"]["stops"].of(after[keys.OBSERVATION])
    known = env.server.messages(after[keys.RECEIVED])
    half = env.server.scales(known) / 2
    for world in range(4):
        elapsed = 0
        for t in range(20):
            elapsed = 0 if after[keys.DONE][world, t] else elapsed + 1
            if not elapsed:
                continue
            now = elapsed * case.clock.dt
            for i in range(AGENTS):
                target = known.target[world, t]
                away = (target - target[i]).norm(dim=-1)
                others = [j for j in away.argsort(stable=True).tolist() if j != i]
                for row, j in enumerate(others):
                    expected = torch.zeros(n_stops, 4)
                    landed = known.landed[world, t, j]
                    for k in (landed >= 0).nonzero().flatten():
                        way = points[known.trail[world, t, j, k]] - target[i]
                        age = (now - landed[k]) / (2 * n_stops * case.clock.dt)
                        facts = torch.stack([age, torch.tensor(1.0)]).clamp(max=1)
                        expected[k] = torch.cat([(way / half[world, t]).clamp(-1, 1), facts])
                    assert stops[world, t, i, row].allclose(expected, atol=1e-5)
