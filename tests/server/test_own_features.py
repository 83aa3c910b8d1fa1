"""What a UAV computes on board of its own features equals what the server would compute of what it
knows."""

import pytest
import torch
from helpers import SQUARE, everything
from twin import GLOBAL, LOCAL

from damian import UavEnv
from damian.common.tensors import tree_map
from damian.server.config import ObservationConfig
from damian.world.config import RegionConfig
from damian.world.messages import Messages


@pytest.mark.parametrize("n_agents", [1, 2, 5])
def test_every_uav_computes_of_itself_what_the_server_would(n_agents):
    region = RegionConfig(
        kind="vertices", vertices=SQUARE, lattice_step=30.0, initial_conditions=16
    )
    observation = ObservationConfig(
        local_features=LOCAL, global_features=GLOBAL, own=True, age=True
    )
    scenario = everything(agents=n_agents, region=region, observation=observation)
    env = UavEnv(scenario, messages_only=True)
    generator = torch.Generator().manual_seed(n_agents)

    def draw(low, high, *shape):
        return low + (high - low) * torch.rand(3, n_agents, n_agents, *shape, generator=generator)

    point = draw(0, len(env.simulation.points), 2).long()
    known = Messages.blank(point)._replace(
        time=draw(0, 20).round(),
        position=draw(-100, 100, 2),
        track=draw(0, 6.28),
        battery=draw(0, 100),
        spotted=draw(0, 1) < 0.4,
        detected_time=draw(-10, 20, 2).round().clamp(min=-1),
        detected_position=draw(-100, 100, 2, 2),
    )
    server = env.server
    steps = torch.tensor([20, 30, 40])
    found = server.observe_each(known, steps)
    for i in range(n_agents):
        one = tree_map(lambda field, i=i: field[:, i], known)
        names = server.observation.actor + server.observation.critic
        expected, _ = server.observations(server.features(one, steps, names))
        assert found[:, i].equal(expected[:, i])
