"""Runs of lost messages: played back from a file, and drawn with a mean length."""

import math
from pathlib import Path

import torch
from delay_twin import drawn
from helpers import play
from torch import Tensor
from transform_cases import OBSERVATION, STEPS, choices, delayed, trace

from damian.common import counter_rng
from damian.delays.laws import Burst
from damian.transforms import ObservationDelay

ROWS = [0, 1, "lost", "lost", "lost", 2, 0, "lost", "lost", 3, 0, 0]
CODES = [-1 if row == "lost" else row for row in ROWS]


def delays(folder: Path, loss: float) -> Tensor:
    """Delays of each sender's messages, -1 for a lost one, [M, T]; episodes end at random."""
    transform = ObservationDelay(trace(folder, *ROWS), [OBSERVATION], loss=loss, delay_key="delay")
    outputs = play(delayed(transform), choices())[1::2]
    return torch.stack([td["agents", "delay"].flatten() for td in outputs], -1)


def test_a_trace_plays_its_runs_of_losses_back_in_the_order_of_the_file(tmp_path):
    rotations = [(CODES * 5)[start : start + STEPS] for start in range(len(CODES))]
    assert all(row in rotations for row in delays(tmp_path, 0.0).tolist())


def test_other_losses_add_to_those_of_a_trace(tmp_path):
    played, found = delays(tmp_path, 0.0), delays(tmp_path, 0.3)
    lost = found[played >= 0] == -1
    assert found.equal(torch.where(found == -1, found, played))
    assert (found == -1)[played == -1].all()
    assert abs(lost.double().mean().item() - 0.3) < 5 * math.sqrt(0.21 / lost.numel())


def test_a_burst_loses_runs_of_messages_of_the_mean_length_1_over_leave():
    sampler = Burst(enter=0.1, leave=0.25, good=0, bad=0, bad_loss=1.0).sampler()
    lost = drawn(sampler, counter_rng.world_seeds(5, 2000), 200) == sampler.lost
    ended = lost[:-1] & ~lost[1:]
    length = lost[:-1].sum().item() / ended.sum().item()  # lost messages per run
    assert abs(length - 4) < 5 * math.sqrt(12 / ended.sum().item())  # the variance is (1 - leave) / leave^2
