"""The order of stored steps, by TorchRL's private names, which its next release may change."""

import torch
from tensordict import TensorDict
from torchrl.data import ReplayBuffer

from damian.replay.time_storage import TimeStorage


def test_the_latest_steps_are_in_order_also_when_the_ring_wraps():
    storage = TimeStorage(2 * 5)
    buffer = ReplayBuffer(storage=storage)
    assert storage.n_steps == 0
    for first in range(0, 9, 3):
        number = torch.arange(first, first + 3).expand(2, 3)
        buffer.extend(TensorDict({"number": number}, [2, 3]))
        n = min(first + 3, 5)
        assert storage.n_steps == n
        assert storage[storage.latest()]["number"][:, 0].tolist() == [*range(first + 3 - n, first + 3)]
    storage.overwrite(storage.latest(2), {"number": torch.zeros(2, 2, dtype=torch.long)})
    assert storage.steps["number"].sum() == 2 * (4 + 5 + 6)
