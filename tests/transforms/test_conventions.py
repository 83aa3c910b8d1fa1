"""What users of TorchRL expect of a transform: names of actions on both sides, functions as distributions."""

import pytest
import torch
from torchrl.envs import Compose, GymEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from damian import (
    ActionDelay,
    ActionHistory,
    ObservationDelay,
    set_seed,
)
from damian.delays.samplers import MessageContext


def test_a_policy_may_write_its_action_under_another_name_than_the_environment_reads():
    plain = TransformedEnv(GymEnv("Pendulum-v1"), ActionDelay(2))
    delays = Compose(
        ActionDelay(2, in_keys_inv=["action"], out_keys_inv=["command"]), ActionHistory(2, "command")
    )
    renamed = TransformedEnv(GymEnv("Pendulum-v1"), delays)
    assert renamed.action_keys == ["command"]
    found = []
    for env, key in ((plain, "action"), (renamed, "command")):
        set_seed(env, 0)
        torch.manual_seed(0)
        now, steps = env.reset(), []
        for _ in range(6):
            now[key] = torch.rand(1) * 4 - 2
            after, now = env.step_and_maybe_reset(now)
            steps.append(torch.cat([after[key], after["next", "observation"]]))
        found.append(torch.stack(steps))
    assert found[0].equal(found[1])
    check_env_specs(renamed)


def drawn(message: MessageContext) -> torch.Tensor:
    """Delays of 1 to 5 steps, each as likely."""
    return 5 * message.uniform


def test_a_function_is_taken_as_a_distribution_of_delays():
    late = ObservationDelay(drawn, delay_key="delay")
    env = TransformedEnv(GymEnv("Pendulum-v1", max_episode_steps=3000), late)
    set_seed(env, 0)
    delays = env.rollout(3000, break_when_any_done=False)["next", "delay"].flatten()
    shares = delays.bincount(minlength=6)[1:] / len(delays)
    assert shares.tolist() == pytest.approx([0.2] * 5, abs=0.03)
