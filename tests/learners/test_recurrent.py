"""Recurrent actors: hidden states in flight, their recomputation in training, and what memory is
good for."""

import itertools

import pytest
import torch
from helpers import everything, learning
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import StepCounter

from damian import BackupdateStorage, DelayConfig, keys, make_env
from damian.envs.recompute import server_recompute
from damian.keys import HIDDEN, HIDDEN_BEFORE
from damian.learners.mappo import Mappo, MappoConfig, policy_terms
from damian.models.actor import make_actor
from damian.models.config import MlpConfig
from damian.recipes.shared.learning import make_collector
from damian.server.config import EpisodeConfig

GRU = MlpConfig(hidden=[16, 8], rnn="gru")
ROUNDING = 3e-5
"""Largest difference between numbers that are computed step by step and in one batch."""

both_kinds_and_motions = pytest.mark.parametrize(
    ("kind", "motion"),
    [
        ("discrete", "instant"),
        ("continuous", "instant"),
        ("discrete", "polynomial"),
    ],
)


def delayed_env(kind="discrete", motion="instant", worlds=4, **changed):
    """An environment with late messages, and episodes of 9 steps."""
    delay = DelayConfig(obs="0..5")
    scenario = everything(
        motion, kind, **({"delay": delay, "episode": EpisodeConfig(max_steps=9)} | changed)
    )
    env = make_env(scenario, worlds, seed=1, extras=["message"])
    env.append_transform(StepCounter())
    return env


def batches(env, actor, steps, n):
    """Collect n consecutive batches [B, T]."""
    collector = make_collector(env, actor, env.batch_size.numel() * steps)
    yield from (batch.clone() for batch in itertools.islice(collector, n))
    collector.shutdown()


def ratios(learner, batch):
    """Importance ratios in the loss, [B, T, N]."""
    return policy_terms(batch.clone(), learner.actor)[1].detach().exp()


@both_kinds_and_motions
def test_hidden_states_are_carried_from_step_to_step_and_start_from_zeros(kind, motion):
    env = delayed_env(kind, motion)
    actor = make_actor(env, GRU)
    collected = torch.cat([*batches(env, actor, 7, 3)], 1)
    begins = collected["is_init"].squeeze(-1)
    assert begins.equal(collected["step_count"].squeeze(-1) == 0)
    assert begins[:, 1:].any()
    assert not begins[:, [7, 14]].all()  # some hidden states are carried from one batch to the next
    before = collected[HIDDEN_BEFORE]
    after = collected[HIDDEN]
    assert (before[begins] == 0).all()
    assert before[:, 1:][~begins[:, 1:]].equal(after[:, :-1][~begins[:, 1:]])
    assert (after != before).any(-1).all()


@both_kinds_and_motions
def test_the_first_importance_ratios_are_one_in_every_batch(kind, motion):
    env = delayed_env(kind, motion)
    learner = Mappo(env, MappoConfig(), learning(GRU))
    for batch in batches(env, learner.actor, 7, 3):
        assert (ratios(learner, batch) - 1).abs().max() < ROUNDING
        minibatch = batch[torch.tensor([2, 0])]
        assert (ratios(learner, minibatch) - 1).abs().max() < ROUNDING


@pytest.mark.parametrize("settle", [0, 5])
def test_a_batch_from_the_replay_buffer_keeps_its_first_hidden_state(settle):
    env = delayed_env()
    recompute = server_recompute(env.server)
    buffer = TensorDictReplayBuffer(storage=BackupdateStorage(40 * 4, recompute, longest=5))
    learner = Mappo(env, MappoConfig(), learning(GRU, settle), buffer)
    parts = [*batches(env, learner.actor, 10, 3)]
    flight = torch.cat(parts, 1)
    begin = 0
    for batch in parts:
        corrected = learner.backupdated_batch(batch)
        flown = flight[:, begin : begin + corrected.shape[1]]
        assert corrected[HIDDEN_BEFORE].equal(flown[HIDDEN_BEFORE])
        assert corrected[keys.OBSERVATION].equal(flown[keys.OBSERVATION])
        assert (ratios(learner, corrected) - 1).abs().max() < ROUNDING
        begin += corrected.shape[1]
    assert begin == 30 - settle
    assert corrected["agents", "backupdated"].any()
    assert (corrected[HIDDEN_BEFORE][:, 0] != 0).any()


def test_gradients_reach_back_to_the_beginning_of_the_episode_and_no_further():
    gru = make_actor(delayed_env(), GRU).module[0][0]
    features = torch.rand(2, 6, 3, 16, requires_grad=True)
    begins = torch.zeros(2, 6, 1, dtype=torch.bool)
    begins[0, 2] = True  # in one of two worlds
    gru.replay(features, torch.rand(2, 3, 8), begins)[:, -1].sum().backward()
    has_gradient = (features.grad != 0).any(-1).all(-1)
    assert has_gradient.tolist() == [[False] * 2 + [True] * 4, [True] * 6]
    assert (features.grad[0, :2] == 0).all()
