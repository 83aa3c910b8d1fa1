"""Seeds that are set right after a reset, as by a collector, which resets its environment when it is made."""

import pytest
import torch
from contract import CASES
from helpers import same
from torchrl.collectors import Collector
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.envs.utils import RandomPolicy, step_mdp

from damian.delays.laws import Uniform
from damian.transforms import ObservationDelay


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_a_collector_may_be_seeded_after_it_was_made(case):
    batches = []
    for earlier in (1, 2):  # the seed while the collector resets the environment has no effect
        env = case.build()
        env.set_seed(0)
        env.transform.set_seed(earlier)
        n_frames, policy = 6 * env.batch_size.numel(), RandomPolicy(env.full_action_spec)
        torch.manual_seed(5)
        collector = Collector(env, policy, frames_per_batch=n_frames, total_frames=n_frames)
        collector.set_seed(3)
        torch.manual_seed(5)
        batches += [batch["next"] for batch in collector]  # a Channel draws at a reset too, before the seed
    assert same(*batches)


def test_the_delays_are_those_of_a_reset_after_the_seed():
    env, twin = (TransformedEnv(GymEnv("Pendulum-v1"), ObservationDelay(Uniform(0, 4))) for _ in range(2))
    env.rollout(5)
    begun = env.reset()
    env.set_seed(3)
    twin.set_seed(3)
    ages = [
        each["next", "age"]
        for each in (env.rollout(30, auto_reset=False, tensordict=begun), twin.rollout(30))
    ]
    assert ages[0].equal(ages[1])


@pytest.mark.parametrize("seeded", [False, True])
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_after_a_step_a_seed_needs_a_reset(case, seeded):
    env = case.build()
    begun = env.reset()
    if seeded:
        env.set_seed(2)
    td = env.step(env.rand_action(begun))
    env.set_seed(3)
    with pytest.raises(RuntimeError, match="reset"):
        env.step(env.rand_action(step_mdp(td)))
