"""The training part of ``recipes/bench.py``: the arms that are compared, and the rows of the table."""

import importlib.util
from dataclasses import replace

import pytest

from damian.envs.pipeline import has_message_delay
from damian.recipes import bench_training
from damian.recipes.bench_training import (
    ARMS,
    HEADER,
    RIVAL,
    RIVALS,
    WIDTHS,
    Seconds,
    arm_config,
    median,
    rows,
    training,
)


def test_arms_differ_in_delay_awareness_compiling_and_critic_only():
    configs = [arm_config(words, worlds=8, steps=16) for words in ARMS]
    assert [has_message_delay(config) for config in configs] == [False] * 3 + [True] * 2
    assert [config.backupdates for config in configs] == [False] * 3 + [True] * 2
    assert [config.compile for config in configs] == [False, True, True, False, True]
    assert [config.model.shared_value for config in configs] == [False, False, True, False, True]
    for config in configs:
        assert (config.agents, config.worlds, config.update_steps) == (3, 8, 16)
        model = replace(config.model, shared_value=False)
        assert (config.learner, model) == (configs[0].learner, configs[0].model)


@pytest.mark.parametrize(("width", "hidden"), [("2 x 64", [64, 64]), ("2 x 256", [256, 256])])
def test_widths_are_those_of_their_names(width, hidden):
    assert arm_config(f"{ARMS[0]} {WIDTHS[width]}", worlds=8, steps=16).model.hidden == hidden


def test_each_part_has_its_own_median():
    measured = [Seconds(1.0, 5.0, 7.0), Seconds(2.0, 4.0, 9.0), Seconds(3.0, 6.0, 8.0)]
    assert median(measured) == Seconds(2.0, 5.0, 8.0)


def test_rows_hold_the_share_of_backupdating_and_the_speed_relative_to_vmas():
    medians = {"ours": Seconds(0.3, 0.1, 0.6), RIVAL: Seconds(1.0, 0.0, 1.0)}
    assert rows(medians, frames=8000) == [
        ("ours", "8,000", "300", "100", "600", "10.0%", "2.00"),
        (RIVAL, "4,000", "1000", "0", "1000", "0.0%", "1.00"),
    ]


def test_without_vmas_there_are_no_ratios():
    assert rows({"ours": Seconds(0.3, 0.1, 0.6)}, frames=8000)[0][-1] == "-"


@pytest.mark.slow
def test_every_arm_trains_and_has_a_row_for_each_width(monkeypatch):
    rivals = RIVALS if importlib.util.find_spec("vmas") else ()
    arms = [words for words in ARMS if "compile" not in words]
    monkeypatch.setattr(bench_training, "ARMS", arms)
    table = training(worlds=2, steps=8, repeats=1)
    assert [row[0] for row in table] == [f"{width}: {name}" for width in WIDTHS for name in [*arms, *rivals]]
    assert {len(row) for row in table} == {len(HEADER)}
