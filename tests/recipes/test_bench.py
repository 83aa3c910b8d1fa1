"""The tables of ``recipes/bench.py``."""

from dataclasses import replace

from damian.recipes.bench import QUICK, delayed, scenarios, step_times


def test_every_environment_of_the_delay_table_is_measured():
    sizes = replace(QUICK, worlds=2, steps=2, repeats=1)
    times = step_times(delayed(scenarios()["everything"], "eager", sizes), sizes.steps, sizes.repeats)
    assert "bare" in times
    assert len(times) > 5
    assert all(ms > 0 for ms in times.values())
