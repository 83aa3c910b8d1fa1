"""Each algorithm learns with each kind of action, of motion, and of awareness."""

import csv
import math

import pytest
from helpers import everything
from settings import LoggerConfig, TrainConfig
from train import train

from damian.delays import DelayConfig
from damian.mappo import MappoConfig
from damian.models import ModelConfig
from damian.sac import SacConfig

AWARE = {
    "none": {},
    "history": {"history": 2},
    "backupdate": {"backupdate": True},
    "both": {"history": 2, "backupdate": True},
}


def config(algo: str, rnn: str, kind: str, motion: str, aware: str) -> TrainConfig:
    """Two rounds of learning under delay."""
    asked = dict(AWARE[aware])
    late = DelayConfig(obs={"law": "uniform", "low": 0, "high": 3}, history=asked.pop("history", 0))
    return TrainConfig(
        **vars(everything(motion, kind, delay=late)),
        algo=algo,
        model=ModelConfig(hidden=[8], rnn=rnn),
        mappo=MappoConfig(steps=12, epochs=1, minibatches=2),
        sac=SacConfig(steps=12, updates=2, batch=16, memory=400, warm_up=0),
        logger=LoggerConfig(tensorboard=False),
        worlds=4,
        frames=96,
        eval_episodes=2,
        **asked,
    )


@pytest.mark.parametrize("aware", AWARE)
@pytest.mark.parametrize("motion", ["instant", "polynomial"])
@pytest.mark.parametrize("kind", ["discrete", "continuous"])
@pytest.mark.parametrize(("algo", "rnn"), [("mappo", "none"), ("sac", "none"), ("mappo", "gru")])
def test_every_combination_learns_and_is_evaluated(tmp_path, algo, rnn, kind, motion, aware):
    train(config(algo, rnn, kind, motion, aware), tmp_path)
    with (tmp_path / "metrics.csv").open(newline="") as file:
        *_, last = csv.DictReader(file)
    losses = [float(value) for name, value in last.items() if name.startswith("loss")]
    assert len(losses) == 3
    assert all(map(math.isfinite, losses))
    assert float(last["frames"]) == 96
    with (tmp_path / "result.csv").open(newline="") as file:
        assert all(math.isfinite(float(row["episode_return"])) for row in csv.DictReader(file))
