"""The features of a belief against plain loops."""

import math
from dataclasses import replace

import pytest
import torch
from belief_twin import chance_at, emission_of
from helpers import everything, square, walking

from damian import UavEnv, feature, make_env
from damian.server.belief import places, predict
from damian.server.config import ObservationConfig
from damian.server.features.belief import BELIEF_RINGS, BELIEF_SECTORS
from damian.world.config import SourceConfig

ALL = ["belief_gain", "belief_moments", "belief_map"]


def believing(own=False, **changed):
    observation = ObservationConfig(
        local_features=["spotted"], global_features=[], belief=ALL, own=own
    )
    return everything(observation=observation, source=walking(), **changed)


@pytest.fixture(scope="module")
def flown():
    """A server, and messages [B, N], elapsed steps [B] and beliefs [B, K, C] of worlds in several
    regions."""
    sources = SourceConfig(
        count=2,
        motion="dynamic",
        emission="per_step",
        each=[{}, {"level_db": 136.0, "emission": "constant"}],
    )
    env = UavEnv(replace(believing(), source=sources), messages_only=True)
    simulation = env.simulation
    server = env.server
    messages = simulation.initial.sent
    steps = simulation.initial.steps
    torch.manual_seed(0)
    possible = server.grid.prior[places(server.grid, server.region_of(messages), None)] > 0
    weight = torch.rand(possible.shape).square() * possible
    belief = weight / weight.sum(-1, keepdim=True)
    return simulation, server, messages, server.features(messages, steps, belief=belief), belief


def test_gain_is_the_chance_of_detecting_the_source_where_an_action_leads(flown):
    simulation, server, messages, features, belief = flown
    candidates = simulation.candidates
    n_actions = simulation.config.actions.n_actions
    for world, uav in ((0, 0), (3, 1), (7, 2)):
        region = int(server.region_of(messages)[world])
        standing = int(messages.trail[world, uav, 0])
        for action in (0, 5, n_actions - 1):
            others = {int(each) for i, each in enumerate(messages.trail[world, :, 0]) if i != uav}
            first = standing * n_actions + action
            base = region * simulation.airspace.max_points
            nearest, second = candidates.ranking.point[first, :2].tolist()
            point = second if base + nearest in others else nearest
            flat = region * simulation.airspace.max_points + point
            missed = 1.0
            for source in range(2):
                place = region + len(server.grid.prior) // 2 * source
                at = standing + len(simulation.points) * source
                chance = chance_at(server.grid, place, belief[world, source], flat - standing + at)
                if flat == standing:  # the UAV stays
                    spots = bool(messages.spots[world, uav, source])
                    again = server.grid.log_reports[
                        2 * at + spots + server.grid.no_report // 2
                    ].exp()
                    found = again if spots else 1 - again
                    next_ = predict(server.grid, belief[world, source], torch.tensor(place))
                    chance = emission_of(server.grid, place) * float(found @ next_)
                missed *= 1 - chance
            found = features["belief_gain"][world, uav, action].item()
            assert found == pytest.approx(1 - missed, rel=1e-3)


def test_moments_are_mean_spread_and_entropy(flown):
    simulation, server, messages, features, belief = flown
    for world, uav, source in ((0, 0, 0), (5, 2, 0), (5, 2, 1)):
        scale = float(simulation.airspace.scale[server.region_of(messages)[world]])
        chance = belief[world, source].tolist()
        cells = server.grid.centres.tolist()
        east, north = (
            sum(p * cell[i] for p, cell in zip(chance, cells, strict=True)) for i in (0, 1)
        )
        squares = ((x - east) ** 2 + (y - north) ** 2 for x, y in cells)
        variance = sum(p * square for p, square in zip(chance, squares, strict=True))
        entropy = -sum(p * math.log(p) for p in chance if p) / math.log(len(chance))
        x, y = messages.position[world, uav].tolist()
        expected = [(east - x) / scale, (north - y) / scale, math.sqrt(variance) / scale, entropy]
        found = features["belief_moments"][world, uav].view(2, 4)[source]
        torch.testing.assert_close(
            found,
            torch.tensor(expected).clamp(-1, 1),
            rtol=1e-3,
            atol=1e-4,
        )


def test_the_map_sums_the_belief_in_each_part_of_the_rings(flown):
    simulation, server, messages, features, belief = flown
    for world, uav, source in ((0, 0, 0), (5, 2, 0), (5, 2, 1)):
        expected = [0.0] * (len(BELIEF_RINGS) + 1) * BELIEF_SECTORS
        x, y = messages.position[world, uav].tolist()
        pairs = zip(belief[world, source].tolist(), server.grid.centres.tolist(), strict=True)
        for p, (east, north) in pairs:
            distance = math.hypot(east - x, north - y)
            ring = sum(distance > radius * simulation.radius for radius in BELIEF_RINGS)
            sector = (
                round(math.atan2(east - x, north - y) / (2 * math.pi) * BELIEF_SECTORS)
                % BELIEF_SECTORS
            )
            expected[ring * BELIEF_SECTORS + sector] += p
        found = features["belief_map"][world, uav].view(2, -1)[source]
        torch.testing.assert_close(
            found,
            torch.tensor(expected),
            rtol=1e-4,
            atol=1e-5,
        )
        assert found.sum().item() == pytest.approx(1, abs=1e-4)


def test_a_uavs_own_features_are_those_of_its_own_belief():
    env = make_env(believing(own=True, delay=believing().delay), 3, extras=["message"])
    td = env.rollout(5)[:, -1]["next"]
    server = env.server
    messages = server.messages(td["agents", "message"])
    steps = torch.full((3,), 5)
    for uav in range(env.uav_env.n_agents):
        features = server.features(messages, steps, ALL, belief=td["agents", "belief"][:, uav])
        own = torch.cat([features[name][:, uav].flatten(1) for name in ALL], -1)
        torch.testing.assert_close(td["agents", "observation"][:, uav, 1:], own)


@feature("belief")
def surest(cache):
    return cache.belief.flatten(-2).amax(-1, keepdim=True).expand_as(cache.messages.time)


def test_a_feature_of_ones_own_may_read_the_belief():
    observation = ObservationConfig(belief=[f"{__name__}:surest"])
    env = make_env(square(observation=observation, source=walking()), 2, extras=["message"])
    td = env.rollout(3)[:, -1]["next"]
    expected = td["belief"].amax(-1).expand(2, 3)
    torch.testing.assert_close(td["agents", "observation"][..., -1], expected)
