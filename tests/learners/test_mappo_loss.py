"""MAPPO's loss beside TorchRL's, its compiled form, its minibatches, and the values of its
critics."""

import copy
from dataclasses import replace

import pytest
import torch
from helpers import everything, learning
from torch.nn.utils import parameters_to_vector
from torchrl.envs import StepCounter
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives.multiagent import MAPPOLoss

from damian import keys, make_env
from damian.common.compiling import COMPILE_OPTIONS, compiled
from damian.learners.mappo import (
    LOSS_KEYS,
    Mappo,
    MappoConfig,
    add_advantages,
    mappo_losses,
    policy_terms,
    state_values,
)
from damian.models.config import MlpConfig
from damian.models.memory import RECURRENT_KEYS, add_recurrent_state
from damian.server.config import EpisodeConfig
from damian.world.config import ActionConfig

SMALL = MlpConfig(hidden=[16, 8])
CONFIG = MappoConfig(clip_epsilon=0.1, entropy_coeff=0.3, critic_coeff=0.7)
CASES = {
    "discrete": (ActionConfig(kind="discrete"), SMALL),
    "continuous": (ActionConfig(kind="continuous"), SMALL),
    "recurrent": (ActionConfig(kind="discrete"), replace(SMALL, rnn="gru")),
    "recurrent, continuous": (ActionConfig(kind="continuous"), replace(SMALL, rnn="gru")),
    "shared value": (ActionConfig(kind="discrete"), replace(SMALL, shared_value=True)),
    "normalised": (ActionConfig(kind="discrete"), SMALL),
}
every_case = pytest.mark.parametrize("case", CASES)


def flown(case, **setup):
    """A learner and a batch [4, 12] with advantages: several episodes of 9 steps, real flight
    times, and importance ratios within and beyond the clipping."""
    actions, model = CASES[case]
    scenario = everything("polynomial", actions=actions, episode=EpisodeConfig(max_steps=9))
    torch.manual_seed(3)
    env = make_env(scenario, 4, seed=1)
    env.append_transform(StepCounter())
    config = replace(CONFIG, minibatches=2, epochs=2, normalize_value=case == "normalised")
    learner = Mappo(env, config, learning(model, **setup))
    add_recurrent_state(env, learner.actor)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        batch = env.rollout(12, learner.actor, break_when_any_done=False)
        add_advantages(batch, learner.critic, learner.config)
    batch[keys.ACTION_LOG_PROB] += 0.2 * torch.randn_like(batch[keys.ACTION_LOG_PROB])
    return env, learner, batch


def loss_entries(learner, batch):
    """What the loss reads of a batch [B, T]."""
    read = [*LOSS_KEYS, *learner.critic.in_keys, *RECURRENT_KEYS]
    return {key: value for key in read if (value := batch.get(key, None)) is not None}


def torchrl_losses(learner, batch):
    """The terms of TorchRL's loss, averaged over decisions, or for the critic over all steps."""
    config = learner.config
    norm = copy.deepcopy(learner.critic.module.norm).float() if config.normalize_value else None
    if norm is not None:
        norm.update = lambda targets: (
            None
        )  # a learner has updated it already, once for the whole batch
    loss = MAPPOLoss(
        learner.actor,
        learner.critic,
        value_norm=norm,
        clip_epsilon=config.clip_epsilon,
        entropy_coeff=config.entropy_coeff,
        critic_coeff=config.critic_coeff,
        normalize_advantage=False,
        reduction="none",
    )
    loss.set_keys(
        action=keys.ACTION,
        value=keys.STATE_VALUE,
        advantage=keys.ADVANTAGE,
        value_target=keys.VALUE_TARGET,
        sample_log_prob=keys.ACTION_LOG_PROB,
    )
    terms = loss(batch.copy())
    ready = batch[keys.READY]
    decided = [
        terms[name].view_as(ready)[ready].mean() for name in ("loss_objective", "loss_entropy")
    ]
    return torch.stack([*decided, terms["loss_critic"].mean()])


def losses_of(learner, batch, config=None):
    """The terms of our loss on all steps of a batch [B, T], but the teacher's."""
    entries = loss_entries(learner, batch)
    config = config or learner.config
    return mappo_losses(entries, learner.actor, learner.critic, config)[0][:3]


def with_gradients(learner, losses):
    """Losses, and the gradient of each of them for every weight."""
    gradients = [
        torch.autograd.grad(loss, learner.weights, retain_graph=True, materialize_grads=True)
        for loss in losses
    ]
    return losses.detach(), [gradient for of_loss in gradients for gradient in of_loss]


@every_case
def test_the_losses_and_their_gradients_are_torchrls(case):
    _, learner, batch = flown(case)
    with torch.no_grad():
        _, log_ratio, _ = policy_terms(batch.copy(), learner.actor)
    ready = batch[keys.READY]
    clipped = ((log_ratio.exp() - 1).abs() > CONFIG.clip_epsilon)[ready].float().mean()
    assert 0.2 < clipped < 0.8
    assert 0.2 < ready.float().mean() < 0.9
    assert keys.ACTION_MASK not in batch.keys(True) or not batch[keys.ACTION_MASK].all()
    torch.manual_seed(0)  # the entropy of continuous actions is drawn
    losses = with_gradients(learner, losses_of(learner, batch))
    torch.manual_seed(0)
    expected = with_gradients(learner, torchrl_losses(learner, batch))
    torch.testing.assert_close(losses, expected, rtol=1e-5, atol=1e-7)
    assert all(gradient.isfinite().all() for gradient in expected[1])
    assert (losses[0] != 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("case", ["discrete", "continuous", "normalised"])
def test_the_compiled_losses_are_those_of_the_uncompiled_function_for_any_number_of_steps(case):
    _, learner, batch = flown(case)
    losses = compiled(learner._losses, options=COMPILE_OPTIONS)
    steps = {key: value.flatten(0, 1) for key, value in loss_entries(learner, batch).items()}
    for n in (24, 23, 48, 5):
        entries = {key: value[:n].clone() for key, value in steps.items()}
        torch.manual_seed(0)
        found, numbers = losses(entries)
        after = torch.rand(1)
        torch.manual_seed(0)
        expected, expected_numbers = learner._losses(entries)
        assert torch.rand(1) == after  # as many draws of torch's generator
        gradients = [
            torch.autograd.grad(terms.sum(), learner.weights) for terms in (found, expected)
        ]
        torch.testing.assert_close(
            (found, numbers), (expected, expected_numbers), rtol=1e-4, atol=1e-6
        )
        torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-6)


# Values.


@pytest.mark.parametrize("case", ["discrete", "shared value"])
def test_values_are_those_of_two_passes_over_the_batch(case):
    _, learner, batch = flown(case)
    key = keys.GLOBAL_OBSERVATION
    batch[keys.next_key(key)][2, 4, 1] += (
        1.0  # a correction after the step that is not before the next one
    )
    ends = batch["next", "done"].squeeze(-1)
    assert ends[:, :-1].any()
    evaluated = []
    hook = learner.critic.register_forward_hook(lambda *call: evaluated.append(call[1][0].numel()))
    with torch.no_grad():
        values = state_values(batch, learner.critic)
        hook.remove()
        expected = (learner.critic(batch.copy()), learner.critic(batch["next"].copy()))
    torch.testing.assert_close(values, tuple(td[keys.STATE_VALUE] for td in expected))
    assert evaluated == [
        batch.numel() + 4 + int(ends[:, :-1].sum()) + 1
    ]  # last steps, ends, correction


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("case", "advantage"),
    [
        ("discrete", True),
        ("discrete", False),
        ("shared value", True),
        ("recurrent", True),
    ],
)
def test_rewards_of_any_scale_teach_the_same_if_values_are_normalised(case, advantage):
    env, _, batch = flown(case)

    def learnt(scale, normalize):
        """The change of the actor's weights by two batches with scaled rewards."""
        torch.manual_seed(3)
        config = MappoConfig(
            epochs=2, minibatches=2, normalize_value=normalize, normalize_advantage=advantage
        )
        learner = Mappo(env, config, learning(CASES[case][1]))
        begin = parameters_to_vector(learner.actor.parameters())
        for part in batch.split(6, 1):
            scaled = part.clone()
            scaled[keys.next_key(keys.REWARD)] *= scale
            learner.learn(scaled)
        return (parameters_to_vector(learner.actor.parameters()) - begin).detach()

    for normalize in (True, False):
        end, *others = (learnt(scale, normalize) for scale in (1.0, 0.01, 100.0))
        moved = end.abs().max()
        spread = max((other - end).abs().max() for other in others) / moved
        assert moved > 1e-3
        assert spread < 1e-2 if normalize else spread > 5e-2
