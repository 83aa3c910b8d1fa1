"""The examples of delays run, and docs/transforms.md shows their code."""

import runpy
from pathlib import Path
from typing import Any

import pytest
from torchrl.envs import SerialEnv

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples" / "transforms"


def run(name: str) -> dict[str, Any]:
    """Run an example; its globals."""
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def test_a_late_pendulum_observes_what_is_some_steps_old(capsys):
    steps = run("late_pendulum")["steps"]
    assert 1 < steps["age"].mean() < 4
    assert steps["observation"].shape == (200, 3 + 5)
    assert f"{steps['age'].mean():.1f} steps" in capsys.readouterr().out


@pytest.mark.slow
def test_agents_of_vmas_have_ages_of_their_own():
    pytest.importorskip("vmas")
    age = run("late_vmas")["age"]
    assert age.shape == (32, 50, 3, 1)
    assert not age[:, :, 0].equal(age[:, :, 1])


def test_agents_of_vmas_hear_what_others_chose_to_say():
    pytest.importorskip("vmas")
    example = run("late_words")
    agents, heard, age = example["agents"], example["heard"], example["age"]
    assert heard.shape == (32, 50, 3, 3, 4)
    assert heard[:, 1:, 0, 0].equal(agents["words"][:, :-1, 0])  # an agent's own message arrives at once
    assert 1 < age[..., 0, 1:].mean() < 5
    assert not agents["received_mask"][:, :, 0, 1].all()


@pytest.mark.slow
def test_a_replay_buffer_contains_late_steps():
    example = run("late_replay_buffer")
    stored = example["buffer"][:]
    assert len(stored) == 500
    assert 1 < stored["age"].mean() < 4
    assert stored["age"][0] == stored["age"][1:][stored["next", "done"][:-1]].max() == 0


def test_workers_draw_the_same_delays_again_each_its_own():
    one, other = run("late_workers")["draw"](SerialEnv)
    assert one != other
    assert run("late_workers")["draw"](SerialEnv) == [one, other]
