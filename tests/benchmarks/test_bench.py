"""The tables of examples/benchmarks, with few worlds and steps."""

import importlib.util
from argparse import Namespace

import bench
import bench_gpu
import bench_training
import pytest
from bench import BARE, WHOLE, delays, methods, rivals, scenarios
from bench_training import HEADER, METHODS, RIVALS, WIDTHS, training

TINY = bench.Sizes(
    worlds=4,
    steps=2,
    batch=2,
    repeats=1,
    many_worlds=(1, 3),
    many_uavs=(1, 5),
    growth_steps=2,
    modes=("eager",),
)


@pytest.fixture(scope="module")
def presets():
    return scenarios()


@pytest.mark.slow
def test_every_environment_of_the_delay_table_is_measured(presets):
    table = bench.cost_of_delays({"everything": presets["everything"]}, TINY)
    assert [row[0] for row in table.rows] == [f"everything: {kind}" for kind in delays()]


@pytest.mark.slow
def test_the_comparison_has_a_row_for_each_method_and_a_figure(presets, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    table = bench.comparison(presets, TINY)
    names = [*rivals(1), *methods(presets, 1, (BARE, WHOLE), ("eager",))]
    assert [row[0] for row in table.rows] == names
    assert (tmp_path / "runs" / "bench.png").exists()


def test_a_ratio_stands_beside_that_which_was_stored():
    before = bench.Table("t", ("what", "ms", "times"), [("a", "4", "1.00"), ("b", "8", "2.00")])
    now = before._replace(rows=[("b", "9", "1.50"), ("c", "6", "1.00")])
    assert now.markdown(before.ratios()).splitlines()[4:] == [
        "| b | 9 | 1.50 (2.00) |",
        "| c | 6 | 1.00 |",
    ]


# The training part.


@pytest.mark.slow
def test_every_method_trains_and_has_a_row_for_each_width(monkeypatch):
    rivals = RIVALS if importlib.util.find_spec("vmas") else ()
    methods = [words for words in METHODS if "compile" not in words]
    monkeypatch.setattr(bench_training, "METHODS", methods)
    table = training(worlds=2, steps=8, repeats=1)
    every = [*methods, bench_training.PRODUCTS, *rivals]
    assert [row[0] for row in table] == [f"{width}: {name}" for width in WIDTHS for name in every]
    assert {len(row) for row in table} == {len(HEADER)}


@pytest.mark.slow
def test_the_script_for_gpus_compares_and_skips_rows_for_which_no_time_is_left(monkeypatch):
    options = Namespace(
        device="cpu",
        worlds=[4],
        trainings=[4],
        minutes=0,
    )
    monkeypatch.setattr(bench_gpu, "LONG", {})
    _, compared, speed, _ = bench_gpu.measure(options)
    assert [f"| {kind}, eager | 0.00e+00 |" in compared for kind in bench_gpu.KINDS] == [True] * 3
    assert speed.count("no time left") == len(bench_gpu.KINDS) + len(bench.RIVAL_TASKS) + 1
