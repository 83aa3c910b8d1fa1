"""The examples of delays run, and docs/transforms.md shows their code."""

import runpy
from pathlib import Path
from typing import Any

import pytest
from torchrl.envs import SerialEnv


def run(name: str) -> dict[str, Any]:
    """Run an example; its globals."""
    path = Path(__file__).parents[2] / "examples" / "transforms" / f"{name}.py"
    return runpy.run_path(str(path), run_name="__main__")


def test_a_late_pendulum_prints_the_age_of_what_it_observes(capsys):
    age = run("late_pendulum")["steps"]["age"].mean()
    assert 1 < age < 4
    assert f"{age:.1f} steps" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "entry"),
    [
        ("late_words", "age"),
        pytest.param("late_vmas", "age", marks=pytest.mark.slow),
        pytest.param("late_replay_buffer", "buffer", marks=pytest.mark.slow),
    ],
)
def test_an_example_runs(name, entry):
    pytest.importorskip("vmas")
    found = run(name)[entry]
    age = found[:]["age"] if entry == "buffer" else found
    assert 0.5 < age.mean() < 5


def test_workers_draw_the_same_delays_again_each_its_own():
    draw = run("late_workers")["draw"]
    one, other = draw(SerialEnv)
    assert one != other
    assert draw(SerialEnv) == [one, other]
