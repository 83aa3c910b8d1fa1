"""The examples run from any folder, and do what their text says; docs/backupdating.md shows the same code."""

import re
import runpy
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "backupdating.py"
DOCUMENT = (ROOT / "docs" / "backupdating.md").read_text()


def test_back_updated_rewards_and_ends_are_the_true_ones_wherever_the_message_has_arrived(capsys):
    example = runpy.run_path(str(EXAMPLE))
    steps, collected = example["main"]()
    after, n_steps = steps["next"], len(steps)
    arrived = torch.arange(n_steps).view(-1, 1, 1) + after["delay"] < n_steps
    assert n_steps - 7 < arrived.sum() / steps.shape[1] < n_steps
    truth = example["judge"](after["message"])
    for name in ("reward", "terminated"):
        assert after[name][arrived].equal(truth[name][arrived])
    assert not collected[arrived].equal(truth["reward"][arrived])
    first_end = truth["terminated"][:60].long().cumsum(0)
    over = (first_end - truth["terminated"][:60].long()) > 0
    first_episode = steps["step_count"][:60] == torch.arange(60).view(-1, 1, 1)
    assert over[first_episode].any()
    assert steps["valid"][:60][first_episode].equal(~over[first_episode])
    printed = re.findall(r"mean error of the (.*): (\S+)", capsys.readouterr().out)
    errors = {name: float(value) for name, value in printed}
    assert errors["reward after back-updating"] < 0.05 * errors["reward as collected"]
    assert errors["message in hindsight"] < 0.05 * errors["message that the room held"]


def test_the_smallest_case_of_the_document_prints_what_stands_below_it(capsys):
    code, printed = re.findall(r"```(?:python)?\n(.*?\n)```", DOCUMENT, re.DOTALL)[:2]
    exec(code, {})
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if "torchrl" not in line] == printed.splitlines()  # it logs there, too


@pytest.mark.slow
def test_a_belief_head_learns_to_predict_on_an_environment_that_is_not_ours(monkeypatch):
    pytest.importorskip("vmas")
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    example = runpy.run_path(str(ROOT / "examples" / "belief_head.py"))
    assert example["batch"]["agents", "timeline"].shape == (8, 16, 3, 12, 18 + 1)
    assert example["errors"][-1] < example["errors"][0]
