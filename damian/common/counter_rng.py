"""Random numbers as a pure function of a key and counters: no generator, no hidden state.

A stream, with a key of 64 bits, draws the same numbers in a batch as alone, on any device and
compiled. The hash is the mixing function of SplitMix64
(Steele, Lea and Flood 2014; multipliers: D. Stafford's variant 13) of the counter, with the key
added within it again, so that each key gives a sequence of its own.
"""

import hashlib
from operator import index

import torch
from torch import Tensor

_MASK = 0xFFFFFFFF
_WEYL = -0x61C8864680B583EB  # 2^64 / golden ratio, as a signed number
_FIRST = -0x40A7B892E31B1A47
_SECOND = -0x6B2FB644ECCEEE15


Counter = Tensor | int


def bits64(key: Tensor, *counters: Counter) -> Tensor:
    """Draw 64 random bits, int64, one for each element of the broadcast shape of key and counters.

    Counters are int64, or one number for all, and tell the draws of a stream apart; their order
    matters.
    """
    for counter in counters:
        product = _product(key, counter)
        key = product ^ ((product >> 31) & 0x1FFFFFFFF)  # a shift fills up with the sign
    return key


def bits(key: Tensor, *counters: Counter) -> Tensor:
    """Draw uniform integers in [0, 2^32); the arguments are those of ``bits64``."""
    return _high(key, counters) & _MASK


def uniform(key: Tensor, *counters: Counter) -> Tensor:
    """Draw uniform floats in [0, 1), multiples of 2^-24; the arguments are those of ``bits64``."""
    return ((_high(key, counters) >> 8) & 0xFFFFFF).to(torch.float32) * 2.0**-24


def _high(key: Tensor, counters: tuple[Counter, ...]) -> Tensor:
    """The upper 32 of 64 random bits, which need no last mixing, with the sign above them."""
    if counters:
        key = _product(bits64(key, *counters[:-1]), counters[-1])
    return key >> 32


def _product(key: Tensor, counter: Counter) -> Tensor:
    """The hash of a counter before the last mixing of the lower bits; int64 wraps."""
    if isinstance(counter, int):
        counter = torch.full_like(key, counter)
    x = (counter * _WEYL) ^ key
    x = (x ^ ((x >> 30) & 0x3FFFFFFFF)) * _FIRST
    x = x + key
    return (x ^ ((x >> 27) & 0x1FFFFFFFFF)) * _SECOND


def world_seeds(seed: int, n_worlds: int, device: torch.device | None = None) -> Tensor:
    """Derive one key for each world from a seed, [B] int64; neighbouring seeds share no streams."""
    wrapped = (index(seed) + 2**63) % 2**64 - 2**63
    base = torch.full((n_worlds,), wrapped, dtype=torch.long, device=device)
    return bits64(base, 0, torch.arange(n_worlds, device=device))


def number_of(text: str) -> int:
    """A 63-bit number that stands for a text: a counter that tells streams of different uses
    apart."""
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "big") >> 1
