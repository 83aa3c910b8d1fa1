"""The batched ``simple_spread``, beside the one of mpe2."""

import numpy as np
import pytest
import torch
from simple_spread import HORIZON, SimpleSpread
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from damian import keys

WORLDS = 12


def crowded(env: SimpleSpread) -> TensorDict:
    """Begin episodes in which agents often touch each other and landmarks lie among them."""
    td = env.reset()
    env.position, env.landmarks = 0.4 * env.position, 0.4 * env.landmarks
    return td


def drawn_actions(env: SimpleSpread) -> torch.Tensor:
    return torch.randint(5, (WORLDS, env.n_agents))


def as_in_mpe2(env: SimpleSpread, world: int, actions: torch.Tensor, ratio: float) -> dict[str, np.ndarray]:
    """What mpe2 makes of a world's state and actions: the next state, observations and rewards."""
    spread = pytest.importorskip("mpe2.simple_spread_v3")
    theirs = spread.parallel_env(N=env.n_agents, local_ratio=ratio, max_cycles=HORIZON)
    theirs.reset(seed=0)
    state = theirs.unwrapped.world
    for i in range(env.n_agents):
        state.agents[i].state.p_pos = env.position[world, i].double().numpy().copy()
        state.agents[i].state.p_vel = env.velocity[world, i].double().numpy().copy()
        state.landmarks[i].state.p_pos = env.landmarks[world, i].double().numpy().copy()
    chosen = {f"agent_{i}": int(actions[world, i]) for i in range(env.n_agents)}
    observations, rewards, *_ = theirs.step(chosen)
    return {
        "position": np.stack([agent.state.p_pos for agent in state.agents]),
        "velocity": np.stack([agent.state.p_vel for agent in state.agents]),
        "observation": np.stack([*observations.values()]),
        "reward": np.stack([*rewards.values()]),
    }


@pytest.mark.parametrize(("agents", "ratio"), [(3, 0.5), (5, 0.2)])
def test_every_step_is_that_of_mpe2(agents, ratio):
    torch.manual_seed(0)
    env = SimpleSpread(WORLDS, agents, ratio)
    env.set_seed(0)
    crowded(env)
    collisions = 0
    for _ in range(HORIZON):
        actions = drawn_actions(env)
        expected = [as_in_mpe2(env, world, actions, ratio) for world in range(WORLDS)]
        after = env.step(TensorDict({keys.ACTION: actions}, [WORLDS]))["next"]
        found = {
            "position": env.position,
            "velocity": env.velocity,
            "observation": after[keys.OBSERVATION],
            "reward": after[keys.REWARD].squeeze(-1),
        }
        for name, values in found.items():
            twin = np.stack([world[name] for world in expected])
            np.testing.assert_allclose(values.numpy(), twin, atol=1e-5, rtol=1e-5, err_msg=name)
        collisions += sum(int((torch.pdist(places) < 0.3).sum()) for places in env.position)
    assert collisions > 30


def test_the_specs_hold_and_episodes_are_truncated_after_25_steps_and_begin_anew():
    env = SimpleSpread(4)
    check_env_specs(env)
    env.set_seed(3)
    steps = env.rollout(2 * HORIZON, break_when_any_done=False)["next"]
    last = torch.arange(2 * HORIZON) % HORIZON == HORIZON - 1
    assert steps[keys.TRUNCATED].squeeze(-1).equal(last.expand(4, -1))
    assert steps[keys.DONE].equal(steps[keys.TRUNCATED])
    assert not steps[keys.TERMINATED].any()
