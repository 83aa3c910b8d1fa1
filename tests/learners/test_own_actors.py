"""One actor for each UAV, instead of one for all."""

import pytest
import torch

from damian import keys
from damian.common.errors import InputError
from damian.envs.config import ScenarioConfig
from damian.envs.pipeline import make_env
from damian.learners.config import ModelConfig
from damian.learners.networks import make_actor


@pytest.mark.parametrize("shared", [True, False])
def test_uavs_that_see_the_same_choose_alike_only_with_a_shared_actor(shared):
    env = make_env(ScenarioConfig(agents=3), 4, 0)
    actor = make_actor(env, ModelConfig(hidden=[16], shared=shared))
    td = env.reset()
    td[keys.OBSERVATION] = td[keys.OBSERVATION][:, :1].expand_as(td[keys.OBSERVATION]).clone()
    td[keys.ACTION_MASK] = torch.ones_like(td[keys.ACTION_MASK])
    logits = actor.get_dist(td).logits
    assert logits[:, 0].allclose(logits[:, 1]) == shared
    assert len([*actor.parameters()]) == 4


def test_own_actors_have_no_memory():
    with pytest.raises(InputError, match=r"model.shared: False goes with model.rnn=none"):
        ModelConfig(shared=False, rnn="gru")
