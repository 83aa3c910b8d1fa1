"""SAC: its targets, its temperature, and the decisions that it draws from the replay buffer."""

import math

import pytest
import torch
from helpers import everything, learning
from tensordict import TensorDict, TensorDictBase
from torchrl.data import ReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import DiscreteSACLoss

from damian import UavEnv, make_env
from damian.keys import OBSERVATION, PRIVILEGED_OBSERVATION, READY
from damian.learners.sac import Sac, SacConfig
from damian.models.config import MlpConfig
from damian.replay.smdp import find_decisions, transitions
from damian.replay.time_storage import TimeStorage
from damian.server.config import EpisodeConfig
from damian.world.config import ActionConfig

SMALL = MlpConfig(hidden=[16])
FAST = SacConfig(updates=2, batch_size=64, warm_up=0)


def learner_of(env, config=FAST, settle=0, steps=200):
    torch.manual_seed(0)
    buffer = ReplayBuffer(storage=TimeStorage(steps * env.batch_size[0]))
    return Sac(env, config, learning(SMALL, settle), buffer)


def fly(env, actor, steps=24):
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        return env.rollout(steps, actor, break_when_any_done=False)


def test_the_target_entropy_is_a_share_of_the_entropy_of_a_uniform_choice_among_legal_actions():
    env = UavEnv(everything(kind="discrete"), 8)
    learner = learner_of(env, SacConfig(target_entropy=0.5))
    n_actions = env.full_action_spec_unbatched["agents", "action"].n
    mask = torch.zeros(2, n_actions, dtype=torch.bool)
    mask[0, :4], mask[1, :16] = True, True
    states = TensorDict({"agents": TensorDict({"action_mask": mask}, [2])}, [2])
    assert torch.allclose(
        learner.loss.target_entropies(states), torch.tensor([4.0, 16.0]).log() / 2
    )
    unmasked = learner.loss.target_entropies(TensorDict({}, [2]))
    assert unmasked.item() == pytest.approx(math.log(n_actions) / 2)


def test_the_target_entropy_of_continuous_actions_is_minus_one_for_each_on_an_interval_of_length_two():
    learner = learner_of(UavEnv(everything(kind="continuous"), 2))  # whose actions lie in [0, 1]
    assert float(learner.loss.target_entropy) == pytest.approx(2 * (math.log(0.5) - 1))


@pytest.mark.parametrize("mask", [True, False])
def test_the_discrete_losses_and_their_gradients_are_torchrls(mask):
    env = UavEnv(everything("polynomial", actions=ActionConfig(kind="discrete", mask=mask)), 8)
    learner = recording_learner(env, lr=0.1)  # so that actor, critics and targets differ
    batch = learner.drawn[0]
    loss = learner.loss
    assert ("agents", "action_mask") not in batch.keys(True) or not batch[
        "agents", "action_mask"
    ].all()
    names = ("loss_actor", "loss_qvalue", "loss_alpha")
    found = loss(batch.copy())
    expected = DiscreteSACLoss.forward(loss, batch.copy())
    # TorchRL has one target for all states, here 0.
    expected["loss_alpha"] = (
        expected["loss_alpha"] - loss.log_alpha * loss.target_entropies(batch).mean()
    )
    assert found["alpha"] == expected["alpha"]
    for name in names:
        gradients = [
            torch.autograd.grad(
                terms[name], [*loss.parameters()], retain_graph=True, materialize_grads=True
            )
            for terms in (found, expected)
        ]
        torch.testing.assert_close(found[name], expected[name])
        torch.testing.assert_close(*gradients)
        assert any((gradient != 0).any() for gradient in gradients[0]), name


class RecordingSac(Sac):
    """Keeps a copy of every batch from which it learns."""

    drawn: tuple[TensorDictBase, ...] = ()

    def update(self, drawn):
        self.drawn = (*self.drawn, drawn.clone())
        return super().update(drawn)


OBSERVED = [OBSERVATION, PRIVILEGED_OBSERVATION]
ROW = [
    *OBSERVED,
    *(("next", *key) for key in OBSERVED),
    ("agents", "action"),
    ("next", "agents", "reward"),
]
ROW += [("next", "done"), ("next", "terminated"), "steps_to_next_obs"]


def rows(batch):
    """Transitions as rows of numbers."""
    return torch.cat([batch[key].view(len(batch), -1) for key in ROW], -1)


def test_updates_draw_from_all_settled_decisions_that_the_replay_buffer_still_holds():
    scenario = everything("polynomial", episode=EpisodeConfig(max_steps=9))
    env = make_env(scenario, 4, seed=1, extras=["privileged"])
    config = SacConfig(gamma=0.8, updates=2, batch_size=600, warm_up=0)
    buffer = ReplayBuffer(storage=TimeStorage(24 * 4))
    learner = RecordingSac(
        env, config, learning(SMALL, 3, critic_key=PRIVILEGED_OBSERVATION), buffer
    )
    flight = fly(env, learner.actor, 40)
    flight["next", "terminated"][::2] = flight["next", "done"][
        ::2
    ]  # no time limit in every other world
    for part in flight.split(8, 1):  # more than the buffer holds, so that old steps are overwritten
        learner.drawn = ()
        learner.learn(part)
    assert [len(drawn) for drawn in learner.drawn] == [600, 600]
    settled = flight[:, 16:37].transpose(0, 1)  # of those that the buffer still holds
    after = settled["next"]
    ends = (after[name].squeeze(-1) for name in ("done", "terminated"))
    decisions = find_decisions(settled[READY], after[READY], *ends)
    observed = [key[-1] for key in OBSERVED]
    expected = rows(transitions(settled, torch.arange(21), decisions, 0.8, observed, 0.0))
    assert 0 < expected[:, -2].sum() < expected[:, -3].sum() < len(expected)  # terminated, done
    drawn = rows(torch.cat(learner.drawn))
    difference = (drawn.unsqueeze(1) - expected).abs().amax(-1)
    assert difference.amin(1).max() < 1e-5  # every drawn decision is expected
    assert difference.amin(0).max() < 1e-5  # every expected decision is drawn


def test_steps_after_an_end_that_was_known_only_later_are_not_learnt_from():
    env = UavEnv(everything("instant", kind="discrete"), 4)
    config = SacConfig(updates=1, batch_size=200, warm_up=0)
    buffer = ReplayBuffer(storage=TimeStorage(200))
    learner = RecordingSac(env, config, learning(SMALL), buffer)
    flight = fly(env, learner.actor, 12)
    flight["valid"] = torch.zeros(4, 12, 1, dtype=torch.bool)
    flight["valid"][:, 7] = True
    learner.learn(flight)
    (drawn,) = learner.drawn
    found = {tuple(row) for row in drawn[OBSERVATION].tolist()}
    assert found == {tuple(row) for row in flight[OBSERVATION][:, 7].flatten(0, 1).tolist()}


def recording_learner(env=None, **changed):
    """A learner that has made one update."""
    env = env or UavEnv(everything(kind="discrete"), 4)
    config = SacConfig(
        **(
            {
                "updates": 1,
                "batch_size": 64,
                "warm_up": 0,
            }
            | changed
        )
    )
    learner = RecordingSac(env, config, learning(SMALL), ReplayBuffer(storage=TimeStorage(100)))
    learner.learn(fly(env, learner.actor, 8))
    return learner
