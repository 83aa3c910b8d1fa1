"""Random numbers as a pure function of (world seed, counter): no generator, no hidden state.

Each world has its own stream, so a world draws the same numbers in a batch as alone, on any device and
under ``torch.compile``. The hash is the 32-bit finaliser "lowbias32" (C. Wellons, "Prospecting for hash
functions", 2018) in int64 arithmetic: good enough for simulation, not for cryptography.
"""

import torch
from torch import Tensor

_MASK = 0xFFFFFFFF


def mix(x: Tensor) -> Tensor:
    """Hash non-negative integers below 2^32 to integers below 2^32; int64 in and out, any shape."""
    x = ((x ^ (x >> 16)) * 0x7FEB352D) & _MASK
    x = ((x ^ (x >> 15)) * 0x846CA68B) & _MASK  # int64 wraps; the low 32 bits stay exact
    return x ^ (x >> 16)


def bits(seed: Tensor, *counters: Tensor) -> Tensor:
    """Draw uniform integers in [0, 2^32), one per element of the broadcast shape of seed and counters."""
    value = seed
    for counter in counters:
        value = mix((value + 0x9E3779B9 * (counter + 1)) & _MASK)
    return value


def uniform(seed: Tensor, *counters: Tensor) -> Tensor:
    """Draw uniform floats in [0, 1), one per element of the broadcast shape of seed and counters."""
    return (bits(seed, *counters) >> 8).to(torch.float32) * 2.0**-24


def world_seeds(seed: int, n_worlds: int, device: torch.device | None = None) -> Tensor:
    """Derive one well-separated seed per world, [B]; neighbouring values of ``seed`` share no streams."""
    base = mix(torch.tensor(seed & _MASK, device=device))
    return bits(base, torch.arange(n_worlds, device=device))
