"""The delays of a scenario are read once, and again only if their settings change."""

from dataclasses import replace

import pytest
from delay_twin import trace
from helpers import square

from damian.delays import laws
from damian.delays.config import DelayConfig, LinkConfig
from damian.envs.pipeline import make_env
from damian.learners.config import MappoConfig
from damian.recipes.config import TrainConfig
from damian.recipes.shared.collectors import learning_env
from damian.recipes.shared.settings import check_learning, learning_setup


@pytest.fixture
def calls(monkeypatch):
    """The keys of all laws that are resolved, and the paths of all traces that are read."""
    resolved, read = [], []
    law_of, read_text = laws.law_of, laws.read_text

    def resolve(written, key="delay"):
        resolved.append(key)
        return law_of(written, key)

    def read_trace(path):
        read.append(path)
        return read_text(path)

    monkeypatch.setattr(laws, "law_of", resolve)
    monkeypatch.setattr(laws, "read_text", read_trace)
    return resolved, read


def test_until_the_first_step_of_a_training_each_law_is_resolved_and_each_trace_read_once(tmp_path, calls):
    delay = DelayConfig(obs=trace(tmp_path, 1, 2, 0), act={"law": "uniform", "high": 2}, rew=1, history=2)
    scenario = square(delay=delay, links=LinkConfig("matrix", delay=1))
    config = TrainConfig(**vars(scenario), learner=MappoConfig(steps=5), worlds=2, backupdate=True)
    check_learning(config)
    learning_setup(config)
    env = learning_env(config)
    make_env(config.eval_scenario, 1)
    env.rollout(3)
    resolved, read = calls
    assert sorted(resolved) == ["delay.act", "delay.obs", "delay.rew", "links.delay"]
    assert len(read) == 1


def test_changed_settings_are_read_anew():
    scenario = square(delay=DelayConfig(obs=3))
    assert scenario.delays.obs.constant_delay == 3
    assert scenario.delays is scenario.delays
    scenario.delay.obs = 5
    assert scenario.delays.obs.constant_delay == 5
    assert replace(scenario, delay=DelayConfig(obs=1)).delays.longest == 1
