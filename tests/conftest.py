"""Settings of every test: a seed, and one thread, because many small tensors are slower on more."""

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _same_every_time():
    torch.manual_seed(0)
