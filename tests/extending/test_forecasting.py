"""The forecast of teammates' places: what it may learn from, that it learns, and that the policy
learns from what it has read."""

import pytest
import torch
from helpers import backupdating_learner, both_kinds, log_prob_in_learning, square

from damian import DelayConfig, keys
from damian.keys import next_key
from damian.server.config import EpisodeConfig, ObservationConfig, RewardConfig
from damian.world.config import ActionConfig

SLOTS = 5
both_encoders = pytest.mark.parametrize("encoder", ["transformer", "gru"])


def build(example, kind="discrete", encoder="transformer", agents=3):
    """A learner of UAVs that cover a square, whose messages are 1 to 3 steps late or lost, and its
    environment."""
    scenario = square(
        agents=agents,
        actions=ActionConfig(kind=kind),
        delay=DelayConfig(obs="1..3", loss=0.1, messages=SLOTS),
        observation=ObservationConfig(global_features=["coverage", "others"], own=True),
        reward=RewardConfig(coverage=1.0),
        episode=EpisodeConfig(max_steps=13, success_share=None),
    )
    learner = example.ForecastConfig(
        name="forecasting:ForecastConfig",
        encoder=encoder,
        steps=30,
        epochs=1,
        minibatches=2,
        forecast_steps=2,
        forecast_batch=40,
        forecast_lr=0.005,
        forecast_buffer=200,
        width=16,
        layers=1,
    )
    return backupdating_learner(scenario, learner)


@torch.no_grad()
def collected(env, actor):
    """A batch [4, 30]."""
    return env.rollout(30, actor, break_when_any_done=False)


def test_an_answer_is_what_a_message_told_that_arrived_within_the_slots(example):
    learner, env = build(example)
    learner.learn(collected(env, learner.actor))
    n_steps = 30 - SLOTS + 1
    first = torch.arange(0, n_steps, 2).repeat_interleave(4)
    world = torch.arange(4).repeat(n_steps // 2)
    _, seen, later = learner.stored(first, world)
    steps = learner.storage.steps[:30]
    place = env.uav_env.server.messages(steps[keys.MESSAGE]).position
    count = steps[keys.STEP_COUNT].squeeze(-1)
    late = steps[next_key(keys.DELAY)].squeeze(-1)
    scale = env.uav_env.simulation.airspace.scale[0]
    n_told = 0
    for i in range(len(first)):
        for slot in range(SLOTS):
            sent = int(first[i]) - slot
            answered = sent + SLOTS - 1  # when the step has come to the last slot
            same = (
                slot <= count[first[i], world[i]] and answered - sent <= count[answered, world[i]]
            )
            for receiver in range(3):
                for sender in range(3):
                    found = later[i, receiver, (sender - receiver) % 3, slot]
                    delay = 0 if count[sent, world[i]] == 0 else late[sent - 1, world[i], sender]
                    told = same and (0 <= delay < SLOTS or sender == receiver)
                    assert bool(found[-1] > 0) == bool(told)
                    if told:
                        expected = place[sent, world[i], sender] / scale
                        torch.testing.assert_close(found[:2], expected)
                        n_told += slot == 0 and sender != receiver
    assert n_told > 50
    assert not seen[..., 1:, 0, -1].all(), "present places are not known"


@both_encoders
def test_it_learns_to_forecast_better_than_the_newest_messages(example, encoder):
    learner, env = build(example, encoder=encoder)
    flown = collected(env, learner.actor)
    learner.learn(flown)
    errors = torch.stack([learner.learn_forecast() for _ in range(120)])
    forecast, newest = errors[-20:].sum(0)
    assert forecast < 0.6 * newest


@both_kinds
def test_learning_to_forecast_does_not_change_what_the_policy_has_done(example, kind):
    learner, env = build(example, kind)
    batch = collected(env, learner.actor)
    before = log_prob_in_learning(learner.actor, batch)
    torch.testing.assert_close(before, batch[keys.ACTION_LOG_PROB])
    learner.buffer.extend(batch)
    shown = batch[example.FORECAST]
    for _ in range(5):
        learner.learn_forecast()
    assert log_prob_in_learning(learner.actor, batch).equal(before)
    assert not learner.actor(batch.clone())[example.FORECAST].equal(shown)


def test_what_is_known_is_not_forecast_and_the_nearest_comes_first(example):
    learner, env = build(example)
    steps = collected(env, learner.actor)
    known = steps[keys.TIMELINE].clone()
    known[..., 1:, 0, :2] = known[..., :1, 0, :2] + torch.tensor([[0.2, 0.1], [-0.1, 0.1]])
    known[..., 0, -1] = 1
    read = steps.select(keys.OBSERVATION).set(keys.TIMELINE, known)
    found = learner.forecaster(read)[example.FORECAST]
    expected = torch.zeros(4, 3)
    expected[:2] = torch.tensor([[-0.2, 0.2, 1], [0.4, 0.2, 1]])
    torch.testing.assert_close(found, expected.expand_as(found))


def test_a_policy_of_three_flies_six_who_see_the_four_nearest(example):
    (three, _), (six, env) = build(example), build(example, agents=6)
    six.actor.load_state_dict(three.actor.state_dict())
    shown = collected(env, six.actor)[example.FORECAST]
    assert shown.shape[-3:] == (6, 4, 3)
    assert (shown[..., 2] == 1).all()
    lengths = shown[..., :2].norm(dim=-1)
    inside = (shown[..., :2].abs() < 1).all(-1).all(-1)
    assert (lengths.diff(dim=-1)[inside] >= 0).all()
