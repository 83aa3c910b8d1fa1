"""Policies that imitate the script or the planner."""

import pytest
import torch
from helpers import learning, random_actions, square

from damian import make_env
from damian.baselines.planner import planner_policy
from damian.baselines.script import script_policy
from damian.common.errors import InputError
from damian.delays.config import DelayConfig
from damian.envs.nodes import EpisodeTotals
from damian.keys import ACTION, MESSAGE, STEP_COUNT, TEACHER_ACTION
from damian.learners.mappo import Mappo, MappoConfig
from damian.learners.teacher import Teacher
from damian.models.config import MlpConfig
from damian.recipes.shared.learning import make_collector
from damian.server.config import EpisodeConfig, RewardConfig
from damian.world.config import RegionConfig

GROUND = {
    "reward": RewardConfig(coverage=1.0, spotted=0.0),
    "region": RegionConfig(min_area=60_000, max_area=90_000),
    "episode": EpisodeConfig(max_steps=5),
}


@pytest.mark.parametrize("name", ["script", "planner"])
def test_a_teacher_chooses_in_a_batch_of_late_messages_what_it_would_have_chosen_there(name):
    late = make_env(square(agents=3, **GROUND, delay=DelayConfig(obs=3)), 4, extras=["message"])
    late.append_transform(EpisodeTotals())
    on_time = make_env(square(agents=3, **GROUND), 4, extras=["message"])
    policy = script_policy(on_time) if name == "script" else planner_policy(on_time, 2)
    generator = torch.Generator().manual_seed(1)
    steps = []
    expected = []
    td, undelayed = late.reset(), on_time.reset()
    for _ in range(8):
        expected.append(policy(undelayed.clone())[ACTION])
        action = random_actions(late.uav_env, generator)
        steps.append(td.select(MESSAGE, STEP_COUNT))
        _, td = late.step_and_maybe_reset(td.set(ACTION, action))
        _, undelayed = on_time.step_and_maybe_reset(undelayed.set(ACTION, action))
    batch = torch.stack(steps, 1)
    assert (batch[STEP_COUNT][:, 5:] < 3).all()  # other episodes
    assert Teacher(late.uav_env, name, 2)(batch).equal(torch.stack(expected, 1))


def test_a_policy_imitates_first_and_then_less_and_less():
    env = make_env(square(**GROUND), 8)
    config = MappoConfig(teacher="script", imitate=320, teacher_fades=320, lr=1e-2)
    learner = Mappo(env, config, learning(MlpConfig(hidden=[32]), worlds=8))
    env = make_env(square(**GROUND), 8, extras=config.reads)
    env.append_transform(EpisodeTotals())
    collector = make_collector(env, learner.actor, 80)
    weights, losses = [], []
    for batch, _ in zip(collector, range(9), strict=False):
        weights.append(learner._weights_of_losses())
        losses.append(learner.learn(batch)["loss_teacher"])
    collector.shutdown()
    assert weights[0] == [0, 0, 1, 1]  # nothing but imitation, and the critic
    assert [each[-1] for each in weights] == [1, 1, 1, 1, 1, 0.75, 0.5, 0.25, 0]
    assert losses[4] < 0.9 * losses[0]
    assert losses[-1] == 0
    assert TEACHER_ACTION not in batch.keys(True)


def test_a_teacher_does_not_know_what_to_choose_for_late_commands():
    setup = learning(MlpConfig(hidden=[8]), action_delay=2)
    with pytest.raises(InputError, match=r"^learner.teacher: script knows [^\n]*$"):
        MappoConfig(teacher="script").check(setup._replace(worlds=8, shortest_period=4))
