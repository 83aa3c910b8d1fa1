"""The learnt belief: its attention and loss beside slow twins, what it may know, and that it
learns."""

import torch
from helpers import backupdating_learner, both_kinds, log_prob_in_learning, square, walking

from damian import DelayConfig, keys
from damian.keys import next_key
from damian.models.config import MlpConfig
from damian.server.config import EpisodeConfig
from damian.world.config import ActionConfig

SMALL = MlpConfig(hidden=[16, 8])


def build(example, kind="discrete"):
    """A learner of few prediction steps, and an environment whose messages are up to 3 steps late
    or lost."""
    scenario = square(
        source=walking(),
        actions=ActionConfig(kind=kind),
        delay=DelayConfig(obs="0..3", loss=0.1, messages=4),
        episode=EpisodeConfig(max_steps=7),
    )
    learner = example.PredictiveMappoConfig(
        name="predictive_mappo:PredictiveMappoConfig",
        steps=12,
        epochs=1,
        minibatches=2,
        prediction_steps=2,
        prediction_batch=16,
        prediction_buffer=200,
    )
    return backupdating_learner(scenario, learner)


@torch.no_grad()
def collected(learner, env):
    """A batch [4, 12] of the learner's actor."""
    return env.rollout(12, learner.actor, break_when_any_done=False)


def encoding(example, *batch):
    """An encoder, and an observation of 5, a timeline of 2 senders and 4 slots of 2 + 1, and 3
    codes of 4."""
    torch.manual_seed(1)
    encoder = example.MessageEncoder(5, 3, 4, SMALL, heads=2, width=6)
    inputs = [torch.rand(*batch, *shape) for shape in ((5,), (2, 4, 3), (3, 4))]
    inputs[1][..., 2] = (inputs[1][..., 2] < 0.6).float()
    return encoder, inputs


def twin(encoder, observation, timeline, code):
    """The encoding of an observation [F], timeline [S, K, C] and code [E], by loops over
    messages."""
    rows = [
        torch.cat([slot, torch.tensor([age / len(slots), float(sender == 0)])])
        for sender, slots in enumerate(timeline)
        for age, slot in enumerate(slots)
    ]
    known = [row for row in rows if row[2] > 0]
    reference = known[0][:2] if known else rows[0][:2]
    asked = torch.cat([observation, reference, code])
    query = encoder.queries(asked).view(2, 6)
    rows = [encoder.embed(torch.cat([row, row[:2] - reference])) for row in known]
    found = []
    for head in range(2):
        weights = torch.stack([(query[head] @ row) / 6**0.5 for row in rows]).exp()
        found.append(sum(w * row for w, row in zip(weights / weights.sum(), rows, strict=True)))
    return encoder.layers(torch.cat([*found, asked]))


def test_the_attention_is_that_of_a_loop_over_heads_and_known_messages(example):
    encoder, (observation, history, codes) = encoding(example, 4, 3)
    history[..., 0, 2] = 1.0
    encoded = encoder(observation, history, codes)
    for i in range(4):
        for j in range(3):
            for q in range(3):
                expected = twin(encoder, observation[i, j], history[i, j], codes[i, j, q])
                torch.testing.assert_close(
                    encoded[i, j, q],
                    expected,
                    atol=1e-5,
                    rtol=1e-4,
                )


def test_targets_use_nothing_that_has_not_arrived_by_now(example):
    learner, env = build(example)
    learner.learn(collected(learner, env))
    storage = learner.storage
    n_steps = len(storage.latest())
    steps = storage.steps[:n_steps]
    late = steps[next_key(keys.DELAY)].squeeze(-1)
    since = torch.arange(n_steps - 1, -1, -1).view(-1, 1, 1)
    missing = (late < 0) | (late > since)
    assert missing[-3:].any()
    torch.manual_seed(4)
    before = learner.sample(learner.last_steps())
    steps[next_key(keys.MESSAGE)][missing] += 50.0  # in place: a slice of the storage
    storage.backupdate(n_steps)
    torch.manual_seed(4)
    after = learner.sample(learner.last_steps())
    assert before[1].equal(after[1])
    assert before[2].equal(after[2])
    assert not before[2].all()


@both_kinds
def test_learning_to_predict_does_not_change_what_the_policy_has_done(example, kind):
    learner, env = build(example, kind)
    batch = collected(learner, env)
    before = log_prob_in_learning(learner.actor, batch)
    torch.testing.assert_close(before, batch[keys.ACTION_LOG_PROB])
    learner.buffer.extend(batch)
    for _ in range(5):
        learner.learn_prediction(learner.last_steps())
    assert log_prob_in_learning(learner.actor, batch).equal(before)
