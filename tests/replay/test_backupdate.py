"""Back-updating with late messages, against the same rollout without delays."""

from dataclasses import replace

import pytest
import torch
from helpers import everything, random_actions, square
from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import StepCounter

from damian.delays.config import DelayConfig
from damian.envs.config import ScenarioConfig
from damian.envs.pipeline import make_env
from damian.envs.recompute import CORRECTED, server_recompute
from damian.envs.uav_env import EXTRAS
from damian.keys import next_key
from damian.replay.backupdate import BackupdateStorage, corrections_of
from damian.server.termination import EpisodeConfig

LONGEST = 5
RANDOM_DELAY = {"law": "uniform", "low": 0, "high": LONGEST}
WORLDS, UAVS = 3, 2


def rollout(scenario: ScenarioConfig, n_steps: int, n_worlds: int = 4) -> TensorDictBase:
    """Steps [B, T] with random actions, the same at each call."""
    env = make_env(scenario, n_worlds, extras=EXTRAS)
    env.append_transform(StepCounter())
    generator = torch.Generator().manual_seed(5)
    td, steps = env.reset(), []
    for _ in range(n_steps):
        stepped, td = env.step_and_maybe_reset(
            td.set(("agents", "action"), random_actions(env.base_env, generator))
        )
        steps.append(stepped.clone())
    return torch.stack(steps, 1)


def buffer(
    scenario: ScenarioConfig, capacity: int, n_worlds: int = 4, actor: bool = False, **options
) -> TensorDictReplayBuffer:
    env = make_env(scenario, n_worlds, extras=EXTRAS)
    corrected = ["reward", "critic", *["actor"] * actor]
    recompute = server_recompute(env.server, corrected, reward_terms=True)
    corrections = corrections_of(env.transform, [CORRECTED[name] for name in corrected])
    storage = BackupdateStorage(capacity * n_worlds, recompute, LONGEST, corrections=corrections)
    return TensorDictReplayBuffer(storage=storage, batch_size=8, **options)


def in_order(replay: TensorDictReplayBuffer, n_steps: int) -> TensorDictBase:
    """The latest stored steps in order of time, [T, B]."""
    storage = replay.storage
    return storage[storage.latest(n_steps)]


@pytest.mark.parametrize("corrected", [["reward"], ["critic"], ["reward", "critic"]], ids="+".join)
def test_only_what_is_named_is_corrected(corrected):
    scenario = square()
    late = rollout(replace(scenario, delay=DelayConfig(obs=3)), 30)
    env = make_env(scenario, 4, extras=EXTRAS)
    storage = BackupdateStorage(60 * 4, server_recompute(env.server, corrected), LONGEST)
    TensorDictReplayBuffer(storage=storage, batch_size=8).extend(late)
    found = storage[storage.latest()[:25]]
    for name in ("reward", "critic"):
        key = next_key(CORRECTED[name])
        unchanged = found[key].equal(late[key].transpose(0, 1)[:25])
        assert unchanged == (name not in corrected)


def test_a_success_that_the_server_hears_of_late_ends_the_episode_where_it_happened():
    scenario = square(episode=EpisodeConfig(max_steps=12, success_share=0.3))
    undelayed = rollout(scenario, 60, 16)
    delayed = rollout(replace(scenario, delay=DelayConfig(obs=3)), 60, 16)
    replay = buffer(scenario, 80, 16)
    replay.extend(delayed)
    corrected = in_order(replay, 60).transpose(0, 1)
    first_episode = corrected["step_count"].squeeze(-1).cumsum(1) == torch.arange(60).cumsum(0)
    valid = first_episode & corrected["valid"].squeeze(-1)
    ends, true_ends = (td["next", "success"].squeeze(-1) for td in (corrected, undelayed))
    for b in range(16):
        steps = valid[b].nonzero().flatten()
        if true_ends[b, : len(steps)].any():
            assert ends[b, steps].tolist() == true_ends[b, : len(steps)].tolist()
    assert (~corrected["valid"]).any()
    assert corrected["next", "done"][corrected["reset_after"]].all()


@pytest.mark.parametrize("as_files", [False, True])
def test_a_saved_storage_continues_in_the_same_way(tmp_path, as_files):
    scenario = everything("instant", episode=EpisodeConfig(max_steps=9))
    delayed = rollout(replace(scenario, delay=DelayConfig(obs=RANDOM_DELAY)), 40)
    one, other = buffer(scenario, 64), buffer(scenario, 64)
    one.extend(delayed[:, :25])
    if as_files:
        one.dumps(tmp_path)
        other.loads(tmp_path)
    else:
        other.load_state_dict(one.state_dict())
    assert other.storage.latest().equal(one.storage.latest())
    for replay in (one, other):
        replay.extend(delayed[:, 25:])
    original, loaded = in_order(one, 40), in_order(other, 40)
    assert all(original[key].equal(loaded[key]) for key in original.keys(True, True) if key != "index")
