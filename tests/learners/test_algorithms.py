"""Every learner learns with every kind of action, motion and delay awareness."""

import csv
import math

import pytest
from helpers import everything

from damian.delays.config import DelayConfig
from damian.learners.mappo import MappoConfig
from damian.learners.networks import ModelConfig
from damian.learners.sac import SacConfig
from damian.recipes.train import train
from damian.settings import LoggerConfig, TrainConfig

AWARE = {
    "none": {},
    "history": {"history": 2},
    "backupdate": {"backupdate": True},
    "both": {"history": 2, "backupdate": True},
}


LEARNERS = {
    "mappo": MappoConfig(steps=12, epochs=1, minibatches=2),
    "sac": SacConfig(steps=12, updates=2, batch_size=16, buffer_steps=400, warm_up=0),
}


def config(learner: str, rnn: str, kind: str, motion: str, aware: str) -> TrainConfig:
    """Settings of a run with two updates, in which messages are up to 3 steps late."""
    awareness = dict(AWARE[aware])
    delay = DelayConfig(obs={"law": "uniform", "low": 0, "high": 3}, history=awareness.pop("history", 0))
    return TrainConfig(
        **vars(everything(motion, kind, delay=delay)),
        learner=LEARNERS[learner],
        model=ModelConfig(hidden=[8], rnn=rnn),
        logger=LoggerConfig(tensorboard=False),
        worlds=4,
        frames=96,
        eval_episodes=2,
        **awareness,
    )


KINDS, MOTIONS = ("discrete", "continuous"), ("instant", "polynomial")


@pytest.mark.sample(4)
@pytest.mark.parametrize("aware", AWARE)
@pytest.mark.parametrize("kind", [KINDS[0], pytest.param(KINDS[1], marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("learner", "rnn"),
    [("mappo", "none"), ("sac", "none"), pytest.param("mappo", "gru", marks=pytest.mark.slow)],
)
def test_every_learner_trains_with_every_kind_of_action_and_awareness_and_is_evaluated(
    tmp_path, learner, rnn, kind, aware
):
    motion = MOTIONS[
        (KINDS.index(kind) + list(AWARE).index(aware)) % 2
    ]  # each motion with each of the others
    train(config(learner, rnn, kind, motion, aware), tmp_path)
    with (tmp_path / "metrics.csv").open(newline="") as file:
        *_, last = csv.DictReader(file)
    losses = [float(value) for name, value in last.items() if name.startswith("loss")]
    assert len(losses) == 3
    assert all(map(math.isfinite, losses))
    assert float(last["frames"]) == 96
    with (tmp_path / "result.csv").open(newline="") as file:
        assert all(math.isfinite(float(row["perceived_return"])) for row in csv.DictReader(file))
