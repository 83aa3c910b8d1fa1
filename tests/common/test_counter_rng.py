"""Random numbers as a function of seed and counter: the hash, uniformity, and separate streams."""

import torch

from damian.common import counter_rng


def test_the_hash_agrees_with_a_plain_python_implementation():
    def lowbias32(x: int) -> int:
        x ^= x >> 16
        x = x * 0x7FEB352D & 0xFFFFFFFF
        x ^= x >> 15
        x = x * 0x846CA68B & 0xFFFFFFFF
        return x ^ (x >> 16)

    numbers = torch.randint(2**32, (1000,), generator=torch.Generator().manual_seed(0))
    assert counter_rng.mix(numbers).tolist() == [lowbias32(x) for x in numbers.tolist()]


def test_uniform_draws_fill_the_unit_interval_evenly_over_seeds_and_over_counters():
    seeds = counter_rng.world_seeds(0, 10_000)
    counter = torch.zeros_like(seeds)
    for draws in (
        counter_rng.uniform(seeds, counter),
        counter_rng.uniform(seeds[:1], torch.arange(10_000)),
        counter_rng.uniform(seeds[:1], torch.arange(10_000), torch.tensor(3)),
    ):
        counts = torch.histc(draws, bins=20, min=0, max=1)
        chi_square = ((counts - 500).square() / 500).sum()
        assert chi_square < 50  # 19 degrees of freedom: exceeded with probability 1/7000


def test_different_worlds_and_seeds_have_different_streams():
    seeds = torch.cat([counter_rng.world_seeds(seed, 4096) for seed in range(4)])
    assert len(seeds.unique()) == len(seeds)
    counters = torch.arange(100)
    first = counter_rng.uniform(seeds[:1], counters)
    second = counter_rng.uniform(seeds[1:2], counters)
    assert torch.corrcoef(torch.stack([first, second]))[0, 1].abs() < 0.3
    assert not torch.equal(first, second)
