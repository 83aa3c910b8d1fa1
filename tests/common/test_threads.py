"""The number of torch's threads within a context, and how many cores there are."""

import pytest
import torch

from damian.common.threads import available_cores, using_threads


def test_the_number_of_threads_holds_within_the_context_only():
    before = torch.get_num_threads()
    with using_threads(3):
        assert torch.get_num_threads() == 3
    with pytest.raises(KeyError), using_threads(3):
        raise KeyError
    assert torch.get_num_threads() == before


def test_the_environment_limits_the_cores(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert available_cores() == 1
