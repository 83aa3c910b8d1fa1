"""Requests that appear at random places; a UAV that lands within its footprint of them serves the
oldest.

A world has M slots. Each holds the latest request that appeared in it: a row of its place, east,
north [m], and the time at which it appeared [s], negative if there was none. A UAV remembers what
it has served by that time of each slot.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from damian.common import counter_rng
from damian.common.tensors import gather_rows, where_rows
from damian.world.regions.polygon import sample_interior
from damian.world.regions.region import Region

_PLACES = 4096
"""Places of each region where requests appear, drawn once."""
_APPEARS = counter_rng.number_of("request appears")
_PLACE = counter_rng.number_of("request place")


class Arrivals(NamedTuple):
    """How many requests appear in a step, and where."""

    chance: Tensor
    """Probability that at least 1, 2, ..., M appear, [M]."""
    places: Tensor
    """Places uniform in each region, [R, P, 2] metres."""
    slots: Tensor
    """Numbers of the slots, [M]; made within a step, they would not compile."""


def poisson_arrivals(
    regions: Sequence[Region], slots: int, mean: float, rng: np.random.Generator
) -> Arrivals:
    """Poisson numbers of requests, ``mean`` in a step, for worlds with M ``slots``."""
    places = [sample_interior(region.polygon, _PLACES, rng) for region in regions]
    # That at least k appear has the probability P(k, mean), the regularised lower incomplete gamma
    # function.
    at_least = torch.arange(1, slots + 1, dtype=torch.float64)
    chance = torch.special.gammainc(at_least, torch.full_like(at_least, mean))
    return Arrivals(
        chance=chance.float(),
        places=torch.as_tensor(np.stack(places), dtype=torch.float32),
        slots=torch.arange(slots),
    )


def is_open(requests: Tensor, served: Tensor) -> Tensor:
    """Which requests [*, M, 3] no UAV has served, as far as its memory [*, N, M] tells, [*, M]
    bool."""
    time = requests[..., 2]
    return (time >= 0) & (time > served.amax(-2))


def appear(
    requests: Tensor, served: Tensor, arrivals: Arrivals, counters: tuple[Tensor, ...], now: Tensor
) -> Tensor:
    """The slots [B, M, 3] after a step, in which requests have appeared; none has when an episode
    begins.

    They take the slots whose requests are served, the oldest first; what finds none is lost.
    ``counters``: the seed, the episode, the step and the region of each world [B]. ``now`` [B] is
    in seconds.
    """
    seed, episode, step, region = (each.unsqueeze(-1) for each in counters)
    share = counter_rng.uniform(seed, _APPEARS, episode, step)
    at_least = (share < arrivals.chance) & (step > 0)
    number = at_least.sum(-1, keepdim=True)
    drawn = counter_rng.bits(seed, _PLACE, episode, step, arrivals.slots)
    n_places = arrivals.places.shape[1]
    row = region * n_places + drawn % n_places
    place = gather_rows(arrivals.places.flatten(0, 1), row)
    time = now[:, None, None].expand_as(place[..., :1])
    new = torch.cat([place, time], -1)
    waits = is_open(requests, served)
    appeared = requests[..., 2].masked_fill(waits, torch.inf)
    rank = appeared.argsort(dim=-1, stable=True).argsort(-1)
    return where_rows((rank < number) & ~waits, new, requests)


def serve(
    requests: Tensor, served: Tensor, position: Tensor, lands: Tensor, radius: float | Tensor
) -> tuple[Tensor, Tensor]:
    """What each UAV has served after its landing, [B, N, M], and whether it serves one now, [B, N]
    bool.

    Each UAV of ``lands`` [B, N] serves the oldest open request within ``radius`` [m], or [B, 1, 1],
    of its ``position`` [B, N, 2]; of several UAVs that would serve the same one, the first does.
    """
    time = requests[..., 2].unsqueeze(-2)  # [B, 1, M]
    ways = position.unsqueeze(-2) - requests[..., None, :, :2]
    near = ways.square().sum(-1) <= radius**2
    waits = is_open(requests, served).unsqueeze(-2)
    wanted = near & lands.unsqueeze(-1) & waits
    oldest = time.where(wanted, torch.inf).argmin(-1, keepdim=True)
    slot = torch.arange(time.shape[-1], device=time.device)
    chosen = (slot == oldest) & wanted  # [B, N, M]
    earliest = chosen.int().cumsum(-2) == 1
    serves = chosen & earliest
    return torch.where(serves, time, served), serves.any(-1)
