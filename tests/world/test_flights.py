"""Where UAVs start."""

import pytest
import torch
from helpers import SQUARE, sent_messages, square, usecase

from damian import UavEnv
from damian.world.config import RegionConfig


def test_uavs_start_on_different_points_or_on_one_or_on_the_given_ones():
    apart = sent_messages(UavEnv(square(), num_worlds=64).reset()).position
    assert (torch.cdist(apart, apart) + 1e9 * torch.eye(3)).min() > 1
    region = RegionConfig(kind="vertices", vertices=SQUARE, start_together=True)
    together = UavEnv(square(region=region), num_worlds=64).reset()
    place = sent_messages(together).position
    assert torch.cdist(place, place).max() == 0
    assert len({tuple(p) for p in place[:, 0].tolist()}) > 10
    env = UavEnv(usecase(2))
    given = sent_messages(env.reset()).position + env.simulation.airspace.offset[0]
    assert given[0].tolist() == [pytest.approx([62.85586449, -119.2183645], abs=1e-4)] * 3
