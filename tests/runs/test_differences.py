"""Sentences on policies beside the script, by paired episodes."""

import pytest
import torch

from damian.runs.metrics import Evaluation
from damian.runs.run_folder import Interval, differences

SCRIPT = torch.tensor([1.0, 5.0, 2.0, 8.0])


def rows(returns):
    found = {"trained": Evaluation(), "script": Evaluation(), "random": Evaluation()}
    for row in found.values():
        row.returns = SCRIPT
    found["trained"].returns = returns
    return found


@pytest.mark.parametrize(
    ("gain", "sentence"),
    [
        ([1.0, 1.2, 0.8, 1.0], "trained: better than the script by 1.00 [0.74, 1.26]."),
        ([-1.0, -1.2, -0.8, -1.0], "trained: the script is better by 1.00 [0.74, 1.26]."),
        ([1.0, -1.0, 2.0, -2.0], "trained: no difference to the script can be seen, 0.00 [-2.91, "),
    ],
)
def test_a_policy_is_compared_with_the_script_episode_by_episode(gain, sentence):
    assert differences(rows(SCRIPT + torch.tensor(gain))).startswith(sentence)


def test_one_episode_has_no_interval():
    assert str(Interval.of(torch.tensor([3.0]))) == "3.00"
