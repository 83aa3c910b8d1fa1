"""The examples of docs/interop.md run as they stand."""

import re
import runpy
from pathlib import Path

import pytest

import damian

TEXT = (Path(damian.__file__).parents[1] / "docs" / "interop.md").read_text()
BLOCKS = re.findall(
    r"## ([^\n]+)\n(?:(?!\n## ).)*?```python\n(.*?)```", "## first\n" + TEXT, re.DOTALL
)


def test_every_example_is_found():
    assert len(BLOCKS) == TEXT.count("```python") == 4


@pytest.mark.parametrize("code", [block for _, block in BLOCKS], ids=[title for title, _ in BLOCKS])
def test_an_example_runs(code):
    found = {}
    exec(code.replace("num_envs=256", "num_envs=4"), found)
    if "picture" in found:
        assert found["picture"].ndim == 3


def test_the_callback_for_stable_baselines3_moves_each_reward_to_the_step_that_earned_it():
    pytest.importorskip("stable_baselines3")
    example = runpy.run_path(
        str(Path(damian.__file__).parents[1] / "examples" / "sb3_late_rewards.py")
    )
    buffers = [
        example["train"](frames=1024, back_update=moved).rollout_buffer for moved in (True, False)
    ]
    settled = [buffer.rewards[: 256 - 30] for buffer in buffers]  # each step of CartPole earns 1
    assert (settled[0] == 1).all()
    assert not (settled[1] == 1).all()
    assert buffers[0].rewards.sum() == buffers[1].rewards.sum()
    assert not (buffers[0].returns == buffers[1].returns).all()
