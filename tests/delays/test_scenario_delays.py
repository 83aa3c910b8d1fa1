"""The delays of a scenario are read once, and again only if their settings change."""

from dataclasses import replace

from delay_twin import trace
from helpers import square

from damian.delays.config import DelayConfig, LinkConfig
from damian.envs.pipeline import make_env
from damian.learners.config import MappoConfig
from damian.recipes.config import TrainConfig
from damian.recipes.shared.learning import learning_env
from damian.recipes.shared.settings import check_learning, learning_setup


def test_until_the_first_step_of_a_training_a_trace_is_read_once(tmp_path):
    delay = DelayConfig(obs=trace(tmp_path, 1, 2, 0), act={"law": "uniform", "high": 2}, rew=1, history=2)
    scenario = square(delay=delay, links=LinkConfig("matrix", delay=1))
    config = TrainConfig(**vars(scenario), learner=MappoConfig(steps=5), worlds=2, backupdate=True)
    check_learning(config)
    next(tmp_path.iterdir()).unlink()  # so that to read it again fails
    learning_setup(config)
    make_env(config, 1)
    learning_env(config).rollout(3)


def test_changed_settings_are_read_anew():
    scenario = square(delay=DelayConfig(obs=3))
    assert scenario.delays.obs.constant_delay == 3
    assert scenario.delays is scenario.delays
    scenario.delay.obs = 5
    assert scenario.delays.obs.constant_delay == 5
    assert replace(scenario, delay=DelayConfig(obs=1)).delays.longest == 1
