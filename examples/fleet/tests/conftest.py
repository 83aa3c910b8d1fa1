"""Settings of every test: a seed, and one thread, because many small tensors are slower on more."""

import os

import pytest
import torch

torch.set_num_threads(1)
os.environ["OMP_NUM_THREADS"] = "1"  # for the programs that tests start


@pytest.fixture(autouse=True)
def _same_every_time():
    torch.manual_seed(0)
