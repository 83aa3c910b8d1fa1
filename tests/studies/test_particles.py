"""The batched ``simple_spread`` and ``simple_tag``, beside those of mpe2."""

import numpy as np
import pytest
import torch
from particles import HORIZON, SimpleSpread, SimpleTag
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from damian import keys

WORLDS = 12


def crowded(env):
    """Begin episodes in which bodies often touch each other and landmarks lie among them."""
    env.reset()
    env.position = 0.4 * env.position
    env.landmarks = 0.4 * env.landmarks


def as_in_mpe2(env, theirs, world, actions):
    """What mpe2 makes of a world's state and actions: the next state, observations and rewards."""
    theirs.reset(seed=0)
    state = theirs.unwrapped.world
    for i, agent in enumerate(state.agents):
        agent.state.p_pos = env.position[world, i].double().numpy().copy()
        agent.state.p_vel = env.velocity[world, i].double().numpy().copy()
    for i, landmark in enumerate(state.landmarks):
        landmark.state.p_pos = env.landmarks[world, i].double().numpy().copy()
    observations, rewards, *_ = theirs.step(
        dict(zip(theirs.agents, actions[world].tolist(), strict=True))
    )
    return {
        "position": np.stack([agent.state.p_pos for agent in state.agents]),
        "velocity": np.stack([agent.state.p_vel for agent in state.agents]),
        "observation": np.stack([*observations.values()][: env.n_agents]),
        "reward": [*rewards.values()][: env.n_agents],
    }


GAMES = {
    "spread": (lambda: SimpleSpread(WORLDS), "spread", {"N": 3, "local_ratio": 0.5}),
    "spread of five": (
        lambda: SimpleSpread(WORLDS, 5, 0.2),
        "spread",
        {"N": 5, "local_ratio": 0.2},
    ),
    "tag": (lambda: SimpleTag(WORLDS), "tag", {}),
}


@pytest.mark.parametrize("game", GAMES)
def test_every_step_is_that_of_mpe2(game):
    make, name, options = GAMES[game]
    theirs = pytest.importorskip(f"mpe2.simple_{name}_v3").parallel_env(
        max_cycles=HORIZON, **options
    )
    torch.manual_seed(0)
    env = make()
    env.set_seed(0)
    crowded(env)
    touching = 0
    for _ in range(HORIZON):
        actions = torch.randint(5, (WORLDS, env.n_agents))
        every = env.chosen(actions)
        expected = [as_in_mpe2(env, theirs, world, every) for world in range(WORLDS)]
        after = env.step(TensorDict({keys.ACTION: actions}, [WORLDS]))["next"]
        found = {
            "position": env.position,
            "velocity": env.velocity,
            "observation": after[keys.OBSERVATION],
            "reward": after[keys.REWARD].squeeze(-1),
        }
        for key, values in found.items():
            twin = np.stack([world[key] for world in expected])
            np.testing.assert_allclose(
                values.numpy(),
                twin,
                atol=1e-5,
                rtol=1e-5,
                err_msg=key,
            )
        touching += sum(
            int((torch.pdist(places) < 2 * env.size[0]).sum()) for places in env.position
        )
    assert touching > 30


def test_a_prey_flees_from_the_nearest_predator_but_not_from_the_plane():
    env = SimpleTag(2)
    env.reset()
    env.position[:] = torch.tensor([[[-0.3, 0.0], [-0.9, 0.5], [-0.9, -0.5], [0.0, 0.0]]] * 2)
    env.position[1, :, 0] += 0.9  # the prey is at the edge
    right = 2
    assert env.chosen(torch.zeros(2, 3, dtype=torch.long))[0].tolist() == [0, 0, 0, right]
    assert env.chosen(torch.zeros(2, 3, dtype=torch.long))[1, 3] != right


@pytest.mark.parametrize("game", [SimpleSpread, SimpleTag])
def test_the_specs_hold_and_episodes_are_truncated_after_25_steps_and_begin_anew(game):
    env = game(4)
    check_env_specs(env)
    env.set_seed(3)
    steps = env.rollout(2 * HORIZON, break_when_any_done=False)["next"]
    last = torch.arange(2 * HORIZON) % HORIZON == HORIZON - 1
    assert steps[keys.TRUNCATED].squeeze(-1).equal(last.expand(4, -1))
    assert steps[keys.DONE].equal(steps[keys.TRUNCATED])
    assert not steps[keys.TERMINATED].any()
