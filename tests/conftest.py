"""Settings of every test: a seed, one thread, and how many examples a property test tries.

One thread, because many small tensors are slower on more. ``make test`` tries the same examples every time;
``make test-deep`` tries thousands of new ones (``--hypothesis-profile=deep``).
"""

import os

import pytest
import torch
from hypothesis import settings

torch.set_num_threads(1)
os.environ["OMP_NUM_THREADS"] = "1"  # for learning, and for the programs that tests start

settings.register_profile("same", derandomize=True, deadline=None, max_examples=100)
settings.register_profile("deep", deadline=None, max_examples=3000, print_blob=True)
settings.load_profile("same")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark property tests, so that ``make test-deep`` finds them."""
    for item in items:
        if getattr(getattr(item, "obj", None), "is_hypothesis_test", False):
            item.add_marker("property")


@pytest.fixture(autouse=True)
def _same_every_time():
    torch.manual_seed(0)
