"""Random numbers as a function of key and counters: the hash, and streams of their own."""

import torch
from streams import overlaps

from damian.common import counter_rng


def test_the_hash_agrees_with_a_plain_python_implementation():
    def mixed(key, counter):
        mask = 2**64 - 1
        x = (counter * 0x9E3779B97F4A7C15 & mask) ^ key
        x = (x ^ x >> 30) * 0xBF58476D1CE4E5B9 & mask
        x = x + key & mask
        return (x ^ x >> 27) * 0x94D049BB133111EB & mask

    generator = torch.Generator().manual_seed(0)
    keys, first, second = (
        torch.randint(-(2**63), 2**63 - 1, (500,), generator=generator) for _ in range(3)
    )
    found = counter_rng.bits64(keys, first, second)
    numbers = zip(
        *((x % 2**64 for x in column.tolist()) for column in (keys, first, second)), strict=True
    )
    before = [
        (key ^ key >> 31, other) for key, other in ((mixed(k, one), o) for k, one, o in numbers)
    ]
    expected = [mixed(key, other) for key, other in before]
    assert [x % 2**64 for x in found.tolist()] == [x ^ x >> 31 for x in expected]
    assert counter_rng.bits(keys, first, second).tolist() == [x >> 32 for x in expected]
    assert counter_rng.uniform(keys, first, second).tolist() == [
        (x >> 40) / 2**24 for x in expected
    ]


def test_no_stream_is_a_section_of_another():
    """Streams that are sections of one sequence share runs of numbers; streams of their own share
    none."""
    keys = counter_rng.world_seeds(0, 4096)
    assert overlaps(counter_rng.bits64(keys.unsqueeze(-1), torch.arange(500))) == 0
    shifted = torch.arange(4096) * 100  # what the check would find otherwise
    assert (
        overlaps(counter_rng.bits64(torch.tensor(0), shifted.unsqueeze(-1) + torch.arange(500)))
        > 1000
    )
