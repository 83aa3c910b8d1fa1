"""Settings of every test: a seed, one thread, and how many examples a property test tries.

One thread, because many small tensors are slower on more. ``make test`` tries the same examples
every time; ``make test-deep`` tries thousands of new ones (``--hypothesis-profile=deep``).
"""

import math
import os
from itertools import groupby
from zlib import crc32

import pytest
import torch
from hydra._internal.hydra import Hydra
from hypothesis import settings

from damian.common.atomic_files import write_atomically
from damian.common.plotting import save_figure

torch.set_num_threads(1)
os.environ["OMP_NUM_THREADS"] = "1"  # for learning, and for the programs that tests start

# Hydra composes a whole configuration only to see whether it sets hydra.mode, as none of ours does.
Hydra.get_mode = lambda *_, **__: None

settings.register_profile("same", derandomize=True, deadline=None, max_examples=50)
settings.register_profile("deep", deadline=None, max_examples=3000, print_blob=True)
settings.load_profile("same")


def pytest_collection_modifyitems(items):
    """Mark property tests, which ``make test-deep`` runs, and the cases that ``sample`` leaves to
    be slow."""
    for item in items:
        if getattr(getattr(item, "obj", None), "is_hypothesis_test", False):
            item.add_marker("property")
    sampled = [
        (item, mark.args[0]) for item in items if (mark := item.get_closest_marker("sample"))
    ]
    sampled.sort(key=lambda pair: (_function(pair[0]), crc32(pair[0].nodeid.encode())))
    for _, group in groupby(sampled, key=lambda pair: _function(pair[0])):
        cases = list(group)
        for item, _ in cases[math.ceil(len(cases) / cases[0][1]) :]:
            item.add_marker("slow")


def _function(item):
    """The test of which the item is a case."""
    return item.nodeid.partition("[")[0]


@pytest.fixture(autouse=True)
def _same_every_time():
    torch.manual_seed(0)


_RENDERED = set()


@pytest.fixture
def few_figures(monkeypatch):
    """Matplotlib renders a figure of each name once in a process, because that is a quarter of the
    smallest training; all are made and written as ever."""

    def save(figure, path, dpi):
        if path.name in _RENDERED:
            write_atomically(path, b"figure")
        else:
            _RENDERED.add(path.name)
            save_figure(figure, path, dpi)

    monkeypatch.setattr("damian.compare.figures.save_figure", save)
