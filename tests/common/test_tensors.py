"""Shared functions of tensors."""

import torch

from damian.common.tensors import distances, nearest_distance


def test_the_nearest_place_compiled_is_at_the_smallest_distance():
    places = torch.rand(4, 3, 5, 2) * 400
    others = torch.rand(4, 3, 7, 2) * 400
    expected = torch.stack([distances(one, others) for one in places.split(1, -2)]).amin(0)
    compiled = torch.compile(nearest_distance, fullgraph=True, backend="aot_eager")
    for found in (nearest_distance(places, others), compiled(places, others)):
        torch.testing.assert_close(found, expected.squeeze(-2))
