"""Requests that appear at random places; a UAV that lands within its footprint of them serves the oldest.

A world has M slots. Each holds the latest request that appeared in it: a row of its place, east, north [m],
and the time at which it appeared [s], negative if there was none. A UAV remembers what it has served by that
time of each slot.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from damian.common import counter_rng
from damian.common.tensors import gather_rows
from damian.world.regions.polygon import sample_interior
from damian.world.regions.region import Region

_PLACES = 4096
"""Places of each region where requests appear, drawn once."""
_APPEARS, _PLACE = counter_rng.number_of("request appears"), counter_rng.number_of("request place")


def request_places(regions: Sequence[Region], rng: np.random.Generator) -> Tensor:
    """Places uniform in each region, [R, P, 2] metres."""
    places = [sample_interior(region.polygon, _PLACES, rng) for region in regions]
    return torch.as_tensor(np.stack(places), dtype=torch.float32)


def is_open(requests: Tensor, served: Tensor) -> Tensor:
    """Which requests [*, M, 3] no UAV has served, as far as its memory [*, N, M] tells, [*, M] bool."""
    time = requests[..., 2]
    return (time >= 0) & (time > served.amax(-2))


def appear(
    requests: Tensor,
    served: Tensor,
    probability: float,
    places: Tensor,
    counters: tuple[Tensor, ...],
    now: Tensor,
) -> Tensor:
    """The slots [B, M, 3] after a step in which a request appears with a probability.

    It takes the slot whose request is the oldest of those that are served; if there is none, it is lost.
    ``places``: of the world's region, [R, P, 2] by ``counters[-1]``, the region [B]; the others are the seed,
    the episode and the step of each world [B]. ``now`` [B] is in seconds.
    """
    seed, episode, step, region = counters
    appears = counter_rng.uniform(seed, torch.full_like(step, _APPEARS), episode, step) < probability
    number = counter_rng.bits(seed, torch.full_like(step, _PLACE), episode, step) % places.shape[1]
    place = gather_rows(places.flatten(0, 1), region * places.shape[1] + number)
    new = torch.cat([place, now.unsqueeze(-1)], -1)
    age = requests[..., 2].masked_fill(is_open(requests, served), torch.inf)
    taken = torch.arange(age.shape[-1], device=age.device) == age.argmin(-1, keepdim=True)
    taken = taken & age.isfinite() & appears.unsqueeze(-1)
    return torch.where(taken.unsqueeze(-1), new.unsqueeze(-2), requests)


def serve(
    requests: Tensor, served: Tensor, position: Tensor, lands: Tensor, radius: float | Tensor
) -> tuple[Tensor, Tensor]:
    """What each UAV has served after its landing, [B, N, M], and whether it serves one now, [B, N] bool.

    Each UAV of ``lands`` [B, N] serves the oldest open request within ``radius`` [m], or [B, 1, 1], of its
    ``position`` [B, N, 2]; of several UAVs that would serve the same one, the first does.
    """
    time = requests[..., 2].unsqueeze(-2)  # [B, 1, M]
    near = (position.unsqueeze(-2) - requests[..., None, :, :2]).square().sum(-1) <= radius**2
    wanted = near & lands.unsqueeze(-1) & is_open(requests, served).unsqueeze(-2)
    oldest = time.where(wanted, torch.inf).argmin(-1, keepdim=True)
    chosen = (torch.arange(time.shape[-1], device=time.device) == oldest) & wanted  # [B, N, M]
    serves = chosen & (chosen.int().cumsum(-2) == 1)
    return torch.where(serves, time, served), serves.any(-1)
