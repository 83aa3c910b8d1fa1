"""Messages between agents on environments of other packages, and what holds for every channel."""

import math
from typing import Any

import pytest
import torch
from delay_twin import Counting
from environments import vmas
from tensordict import TensorDictBase
from torchrl.data import Bounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import check_env_specs

from damian.delays.laws import Burst, Uniform
from damian.transforms import Channel

LATE = Uniform(0, 3)
MESSAGE, OBSERVATION, RECEIVED = (("agents", name) for name in ("message", "observation", "received"))
WRITTEN = [("agents", name) for name in ("received", "received_age", "received_mask")]
WORLDS, N = [3, 5, 8], 3
HEARS = [[True, True, False], [False, True, True], [True, False, True]]
CHANNELS = {
    "all": {},
    "limit": {"limit": 2, "loss": 0.2},
    "matrix": {"hears": HEARS, "loss": [[0.0, 0.5, 0.1]] * 3},
    "laws": {"delay": [[0, 3, LATE], [Burst(), 0, 1], ["2s", 0, 0]], "known_at_reset": True},
    "range": {"comm_range": 0.8, "position_key": "observation"},
    "message": {"action_key": MESSAGE, "message_size": 2},
}
every_channel = pytest.mark.parametrize("options", CHANNELS.values(), ids=CHANNELS)


def channel(**options: Any) -> Channel:
    return Channel(options.pop("delay", LATE), seed=1, **options)


def pettingzoo() -> EnvBase:
    pytest.importorskip("pettingzoo")
    spread = pytest.importorskip("mpe2.simple_spread_v3")
    from torchrl.envs.libs.pettingzoo import PettingZooWrapper  # noqa: PLC0415

    game = spread.parallel_env(N=N, max_cycles=5, continuous_actions=True)
    return PettingZooWrapper(game)


def outputs_of(env: EnvBase, n_steps: int = 25) -> list[TensorDictBase]:
    """What every step and every reset writes, under random actions, which are always the same."""
    torch.manual_seed(0)
    td, seen = env.reset(), []
    for _ in range(n_steps):
        stepped, td = env.step_and_maybe_reset(env.rand_action(td))
        seen += [stepped["next"].clone(), td.clone()]
    return seen


# Environments.


@every_channel
def test_the_outputs_match_specs_that_can_be_indexed(options):
    env = TransformedEnv(vmas(n_agents=N, max_steps=6), channel(**options))
    check_env_specs(env, break_when_any_done="both")
    assert env.rollout(9, break_when_any_done=False)[WRITTEN[1]].shape == (2, 9, N, N)
    for specs in (env.observation_spec, env.full_action_spec):
        assert specs[0].shape == ()
        assert specs["agents"][0, 1].shape == ()


def test_a_chosen_message_is_an_action_that_the_environment_never_gets():
    env = TransformedEnv(pettingzoo(), Channel(1, action_key=("agent", "message"), message_size=4))
    assert isinstance(env.full_action_spec["agent", "message"], Bounded)
    assert ("agent", "message") not in env.base_env.full_action_spec.keys(True)
    check_env_specs(env)
    got = []
    step = env.base_env._step
    env.base_env._step = lambda td: got.append(td) or step(td)
    late = env.rollout(5)
    assert all(("agent", "message") not in td.keys(True) for td in got)
    sent, received = late["agent", "message"], late["next", "agent", "received"]
    assert received[1:, 0, 2].equal(sent[:-1, 2])
    assert received[:, 1, 1].equal(sent[:, 1])
    assert not late["agent", "received_mask"][0].any()


# Properties.


def test_a_limited_medium_is_shared_fairly():
    env = TransformedEnv(Counting([*range(200)], N, ends=0.0), Channel(0, limit=1, seed=1))
    fresh = torch.stack([td[WRITTEN[1]] == 0 for td in outputs_of(env, 20)[::2]])
    others = ~torch.eye(N, dtype=torch.bool)
    assert (fresh & others).flatten(-2).sum(-1).eq(N - 1).all()
    counts = (fresh & others).flatten(0, 1)[:, [1, 2, 0], [0, 1, 2]].sum(0)
    expected, n = 20 * 200 / N, 20 * 200
    assert all(abs(count - expected) < 5 * math.sqrt(n * 2 / 9) for count in counts.tolist())
