"""BPQL: critics read states that have arrived, and the actor what had arrived and its own actions
since."""

import pytest
import torch
from helpers import both_kinds, everything, learning
from torchrl.data import ReplayBuffer
from torchrl.envs import StepCounter
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian import BackupdateStorage, DelayConfig, keys, make_env
from damian.common.errors import InputError
from damian.envs.recompute import server_recompute
from damian.learners.config import BpqlConfig
from damian.models.config import MlpConfig
from damian.server.config import EpisodeConfig

SMALL = MlpConfig(hidden=[16])
LONGEST = 5


def learnt(kind="discrete", steps=40):
    """A learner after several batches, all steps that it was given [B, T], and the last transitions
    drawn."""
    delay = DelayConfig(
        obs=f"0..{LONGEST}",
        history=3,
    )
    scenario = everything(kind=kind, delay=delay, episode=EpisodeConfig(max_steps=9))
    env = make_env(scenario, 4, 1, extras=["message", "privileged"])
    env.append_transform(StepCounter())
    storage = BackupdateStorage(60 * 4, server_recompute(env.server), LONGEST)
    torch.manual_seed(0)
    config = BpqlConfig(updates=1, batch_size=300, warm_up=0, alpha_init=0.5)
    setup = learning(SMALL, backupdate=True, longest_delay=LONGEST)
    learner = config.make(env, setup, ReplayBuffer(storage=storage))
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        flight = env.rollout(steps, learner.actor, break_when_any_done=False)
    drawn = []
    update = learner.update

    def recording(batch):
        drawn.append(batch.clone())
        return update(batch)

    learner.update = recording
    for part in flight.split(8, 1):
        learner.learn(part)
    return learner, flight, drawn[-1]


def rows(steps):
    """What an update reads of each decision: the actor's observation, and a state, before and after
    it."""
    before = steps["agents"]
    after = steps["next", "agents"]
    read = ("observation", "global_observation")
    return torch.cat([each[key] for each in (before, after) for key in read], -1)


@both_kinds
def test_critics_learn_from_undelayed_states_which_have_arrived_and_the_actor_from_what_it_saw(
    kind,
):
    _, flight, drawn = learnt(kind)
    late = flight[:, : 40 - LONGEST]  # the messages of later steps may still be on their way
    undelayed = late.clone()
    for agents in (undelayed["agents"], undelayed["next", "agents"]):
        agents["global_observation"] = agents["privileged_observation"][..., :-2]  # no source
    expected = rows(undelayed).flatten(0, 2)
    differences = (rows(drawn).unsqueeze(1) - expected).abs().amax(-1)
    assert differences.amin(1).max() < 1e-5, "each drawn transition is one of them"
    assert (rows(late).flatten(0, 2) - expected).abs().max() > 0.1, "as collected, they were late"


def test_bpql_waits_for_states_and_refuses_to_learn_without_back_updating():
    learner, *_ = learnt(steps=8)
    assert learner.setup.settle_steps == LONGEST
    config = BpqlConfig()
    with pytest.raises(InputError, match="learner: bpql needs back-updating"):
        config.check(learning(SMALL, longest_delay=3))
    config.check(learning(SMALL, longest_delay=3, backupdate=True))
    config.check(
        learning(SMALL, longest_delay=3, critic_key=keys.PRIVILEGED_OBSERVATION)
    )  # always true
    config.check(learning(SMALL))  # nothing is late
