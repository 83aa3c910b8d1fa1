"""Models, losses and the learner: what is learnt from, by whom, and what it does to importance ratios."""

import itertools

import pytest
import torch
from helpers import both_kinds, both_motions, everything, learning
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import StepCounter
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian.baselines.random import random_policy
from damian.delays.config import DelayConfig
from damian.envs.pipeline import make_env
from damian.envs.scenario import ScenarioConfig
from damian.envs.uav_env import UavEnv
from damian.learners.mappo import Mappo, MappoConfig, add_advantages, mappo_loss, minibatch_losses
from damian.learners.networks import ModelConfig, make_actor, make_critic
from damian.replay.backupdate import BackupdateStorage
from damian.replay.recompute import server_recompute
from damian.server.rewards import RewardConfig
from damian.server.termination import EpisodeConfig
from damian.world.landing import ActionConfig
from damian.world.messages import Messages
from damian.world.motion import MotionConfig
from damian.world.regions.config import RegionConfig

SMALL = ModelConfig(hidden=[16])
REWARD = ("next", "agents", "reward")


def scenario(**changes) -> ScenarioConfig:
    region = RegionConfig(min_area=20_000, max_area=40_000, initial_conditions=16)
    return ScenarioConfig(**{"agents": 3, "region": region, **changes})


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_a_policy_trained_with_three_uavs_flies_ten(kind):
    actions = ActionConfig(kind=kind)
    actor = make_actor(UavEnv(scenario(actions=actions), 2), SMALL)
    ten = UavEnv(scenario(agents=10, actions=actions), 2)
    flown = ten.rollout(4, actor)
    assert flown["agents", "action"].shape[:3] == (2, 4, 10)
    assert flown["agents", "action_log_prob"].shape == (2, 4, 10)


def test_one_policy_is_shared_so_that_swapping_uavs_swaps_their_actions():
    env = UavEnv(scenario(), 4)
    actor, critic = make_actor(env, SMALL), make_critic(env, SMALL)
    seen = env.rollout(3)[:, -1].select(("agents", "observation"), ("agents", "global_observation"))
    order = torch.tensor([2, 0, 1])
    swapped = seen.clone()
    for key in ("observation", "global_observation"):
        swapped["agents", key] = seen["agents", key][:, order]
    logits = actor.module[0](seen.clone())["agents", "logits"]
    assert torch.equal(actor.module[0](swapped)["agents", "logits"], logits[:, order])
    values = critic(seen.clone())["agents", "state_value"]
    assert torch.equal(critic(swapped)["agents", "state_value"], values[:, order])


@pytest.mark.parametrize("make", [lambda env: make_actor(env, SMALL), random_policy])
@pytest.mark.parametrize("motion", ["instant", "polynomial"])
def test_masked_policies_never_choose_an_illegal_action(make, motion):
    env = UavEnv(scenario(motion=MotionConfig(kind=motion)), 32)
    flown = env.rollout(20, make(env), break_when_any_done=False)
    chosen = flown["agents", "action_mask"].gather(-1, flown["agents", "action"].unsqueeze(-1))
    assert not flown["agents", "action_mask"].all()
    assert chosen.all()


def test_continuous_actions_lie_in_the_unit_square():
    env = UavEnv(scenario(actions=ActionConfig(kind="continuous")), 32)
    for policy in (make_actor(env, SMALL), random_policy(env)):
        with set_exploration_type(ExplorationType.RANDOM):
            action = env.rollout(5, policy)["agents", "action"]
        assert action.shape[-1] == 2
        assert action.min() >= 0
        assert action.max() <= 1
        assert action.std() > 0.1


def collected(motion: str, kind: str):
    """Episodes of 9 steps; every other world ends for good, the others by the time limit."""
    config = scenario(
        episode=EpisodeConfig(max_steps=9),
        motion=MotionConfig(kind=motion),
        actions=ActionConfig(kind=kind),
        reward=RewardConfig(spotted=1.0, source_distance=1.0),
    )
    env = UavEnv(config, 8)
    actor, critic = make_actor(env, SMALL), make_critic(env, SMALL)
    batch = env.rollout(24, actor, break_when_any_done=False)
    batch["next", "terminated"][::2] = batch["next", "done"][::2]
    return batch, critic


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_nothing_is_learnt_from_actions_that_were_none(kind):
    batch, critic = collected("polynomial", kind)
    add_advantages(batch, critic, MappoConfig())
    ready = batch["agents", "ready"]
    assert 0 < ready.float().mean() < 1
    assert (batch["agents", "advantage"][~ready] == 0).all()
    assert (batch["agents", "advantage"][ready] != 0).any()


@pytest.mark.parametrize(("kind", "mask"), [("discrete", True), ("discrete", False), ("continuous", True)])
def test_entries_without_a_decision_move_the_critic_only(kind, mask):
    config = scenario(actions=ActionConfig(kind=kind, mask=mask))
    env = UavEnv(config, 4)
    actor, critic = make_actor(env, SMALL), make_critic(env, SMALL)
    loss = mappo_loss(actor, critic, MappoConfig())
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        batch = env.rollout(6, actor, break_when_any_done=False)

    def gradients(ready: bool) -> tuple[float, float]:
        batch["agents", "ready"] = torch.full_like(batch["agents", "ready"], ready)
        add_advantages(batch, critic, MappoConfig())
        loss.zero_grad()
        sum(minibatch_losses(batch.reshape(-1), loss).values()).backward()
        grads = {n: p.grad.abs().sum().item() for n, p in loss.named_parameters() if p.grad is not None}
        actors = sum(g for n, g in grads.items() if n.startswith("actor"))
        return actors, sum(grads.values()) - actors

    actor_moves, critic_moves = gradients(ready=True)
    assert actor_moves > 0
    assert critic_moves > 0
    assert gradients(ready=False)[0] == 0
    assert gradients(ready=False)[1] > 0


def test_objective_and_entropy_are_means_over_decisions():
    env = UavEnv(scenario(motion=MotionConfig(kind="polynomial")), 8)
    actor, critic = make_actor(env, SMALL), make_critic(env, SMALL)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        batch = env.rollout(12, actor, break_when_any_done=False)
    add_advantages(batch, critic, MappoConfig())
    ready = batch["agents", "ready"]
    batch["agents", "advantage"] = torch.where(ready, 2.0, 5.0).unsqueeze(-1)
    assert not ready.all()
    losses = minibatch_losses(batch.reshape(-1), mappo_loss(actor, critic, MappoConfig(entropy_coeff=0.1)))
    assert losses["loss_objective"].item() == pytest.approx(-2, abs=1e-5)  # ratios of 1
    entropy = actor.get_dist(batch).entropy()[ready].mean().item()
    assert losses["loss_entropy"].item() == pytest.approx(-0.1 * entropy, rel=1e-5)


def test_advantages_are_scaled_over_decisions_only():
    batch, critic = collected("polynomial", "discrete")
    add_advantages(batch, critic, MappoConfig())
    advantage = batch["agents", "advantage"][batch["agents", "ready"]]
    assert advantage.mean().item() == pytest.approx(0, abs=1e-5)
    assert advantage.std(correction=0).item() == pytest.approx(1, abs=1e-4)


@both_motions
def test_advantages_are_the_generalised_estimate_over_the_decisions_of_each_uav(motion):
    config = MappoConfig(gamma=0.9, lmbda=0.8, normalize_advantage=False)
    batch, critic = collected(motion, "discrete")
    add_advantages(batch, critic, config)
    value, reward = (batch[key].squeeze(-1) for key in (("agents", "state_value"), REWARD))
    after = batch["next", "agents", "state_value"].squeeze(-1)
    ready, then = batch["agents", "ready"], batch["next", "agents", "ready"]
    compared = 0
    for world, uav in itertools.product(range(8), range(3)):
        estimate = 0.0  # of the decision after this one
        for t in reversed(range(24)):
            if not ready[world, t, uav]:
                continue
            earned, discount, last = 0.0, 1.0, t
            while True:  # until the next decision, an end, or the end of what is known
                earned += discount * reward[world, last, uav].item()
                discount *= 0.9
                over = batch["next", "done"][world, last].item()
                if over or then[world, last, uav] or last == 23:
                    break
                last += 1
            alive = not batch["next", "terminated"][world, last].item()
            delta = earned + alive * discount * after[world, last, uav].item() - value[world, t, uav].item()
            follows = 0.0 if over or last == 23 else discount * 0.8 * estimate
            estimate = delta + follows
            got = batch["agents", "advantage"][world, t, uav].item()
            assert got == pytest.approx(estimate, abs=1e-5)
            compared += 1
    assert compared > 100


def test_a_flight_of_three_steps_earns_what_comes_meanwhile_and_the_value_where_it_lands():
    """By hand: gamma 1/2, rewards 1, 2, 4, and values 8 before the flight, 16 after it."""
    agents = {
        "ready": torch.tensor([True, False, False]).view(1, 3, 1),
        "global_observation": torch.tensor([8.0, 100.0, -100.0]).view(1, 3, 1, 1),
    }
    after = {
        "ready": torch.tensor([False, False, True]).view(1, 3, 1),
        "global_observation": torch.tensor([100.0, -100.0, 16.0]).view(1, 3, 1, 1),
        "reward": torch.tensor([1.0, 2.0, 4.0]).view(1, 3, 1, 1),
    }
    no = torch.zeros(1, 3, 1, dtype=torch.bool)
    flight = TensorDict({"agents": agents, "next": {"agents": after, "done": no, "terminated": no}}, [1, 3])
    critic = TensorDictModule(
        torch.nn.Identity(), [("agents", "global_observation")], [("agents", "state_value")]
    )
    add_advantages(flight, critic, MappoConfig(gamma=0.5, lmbda=0.7, normalize_advantage=False))
    assert flight["agents", "advantage"].flatten().tolist() == [1 + 2 / 2 + 4 / 4 + 16 / 8 - 8, 0.0, 0.0]
    targets = [1 + 2 / 2 + 4 / 4 + 16 / 8, 2 + 4 / 2 + 16 / 4, 4 + 16 / 2]
    assert flight["agents", "value_target"].flatten().tolist() == targets
    add_advantages(flight, critic, MappoConfig(gamma=0.5, lmbda=0.7))
    assert flight["agents", "advantage"].flatten().tolist() == [0.0, 0.0, 0.0]  # one decision is the mean
    assert flight["agents", "value_target"].flatten().tolist() == targets


def test_the_critic_alone_sees_global_features_under_ctde():
    config = scenario()
    config.observation.ctde = True
    env = UavEnv(config, 2)
    assert env.observation_spec["agents", "observation"].shape[-1] == 1
    assert env.observation_spec["agents", "global_observation"].shape[-1] == 4
    config.observation.ctde = False
    env = UavEnv(config, 2)
    assert env.observation_spec["agents", "observation"].shape[-1] == 4


# What hindsight does to the importance ratios of the first pass.

ROUNDING = 1e-4
"""Of log-probabilities that are computed step by step, and in one batch."""


def collected_late(kind: str, recompute_actor: bool) -> tuple[Mappo, TensorDictBase]:
    """A learner with back-updating, and a batch that its actor has flown under delay, with episodes' ends."""
    late = DelayConfig(obs={"law": "uniform", "low": 0, "high": 5}, history=2)
    scenario = everything(kind=kind, delay=late, episode=EpisodeConfig(max_steps=9))
    env = make_env(scenario, 4, seed=1, extras=["message"])
    env.append_transform(StepCounter())
    view = server_recompute(env.server, actor=recompute_actor)
    memory = TensorDictReplayBuffer(storage=BackupdateStorage(40 * 4, view, longest=5))
    torch.manual_seed(2)
    config = MappoConfig(minibatches=1, epochs=1)
    learner = Mappo(env, config, learning(SMALL, recompute_actor=recompute_actor), memory)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        return learner, env.rollout(30, learner.actor, break_when_any_done=False)


@torch.no_grad()
def log_ratios(learner: Mappo, known: TensorDictBase, behaviour: Tensor) -> Tensor:
    """Of the importance ratios of what is learnt from, [B, T, N]."""
    return learner.actor.get_dist(known.clone()).log_prob(known["agents", "action"]) - behaviour


@both_kinds
def test_with_backupdating_the_first_importance_ratios_are_one_as_the_actor_saw_what_it_saw(kind):
    learner, batch = collected_late(kind, recompute_actor=False)
    known, behaviour = learner.backupdated_batch(batch), batch["agents", "action_log_prob"]
    assert known["agents", "observation"].equal(batch["agents", "observation"])
    assert known["agents", "action_log_prob"].equal(behaviour)
    assert known["agents", "backupdated"].any()
    assert log_ratios(learner, known, behaviour).abs().max() < ROUNDING


@both_kinds
def test_recompute_actor_hides_that_corrected_observations_were_never_acted_on(kind):
    learner, batch = collected_late(kind, recompute_actor=True)
    known, behaviour = learner.backupdated_batch(batch), batch["agents", "action_log_prob"]
    assert known["agents", "action"].equal(batch["agents", "action"])
    corrected = (known["agents", "observation"] != batch["agents", "observation"]).any(-1)
    assert 0.1 < corrected.float().mean() < 0.9
    # What the loss is told: as if the actor had chosen with what came later.
    assert log_ratios(learner, known, known["agents", "action_log_prob"]).abs().max() < ROUNDING
    # What it did: another probability wherever something was corrected, and nowhere else.
    true = log_ratios(learner, known, behaviour)
    assert true.abs()[~corrected].max() < ROUNDING
    assert (true.abs()[corrected] > ROUNDING).float().mean() > 0.95
    assert (true.exp() - 1).abs()[corrected].mean() > 0.01


def test_an_observation_is_corrected_where_a_message_came_late_for_the_step_before():
    learner, batch = collected_late("discrete", recompute_actor=True)
    known = learner.backupdated_batch(batch)
    corrected = (known["agents", "observation"] != batch["agents", "observation"]).any(-1).any(-1)
    late = known["agents", "backupdated"].squeeze(-1).any(-1)
    begins = batch["step_count"].squeeze(-1) == 0
    assert begins[:, 1:].any()
    assert not corrected[begins].any()
    assert not (corrected[:, 1:] & ~late[:, :-1]).any()


def test_what_has_settled_is_learnt_from_later_and_then_as_it_truly_was():
    learner, flight = collected_late("discrete", recompute_actor=False)
    short = everything(episode=EpisodeConfig(max_steps=9))
    learner.setup = learning(SMALL, 5)
    server = make_env(short, 4, seed=1).server
    known = torch.cat([learner.backupdated_batch(flight[:, t : t + 10]) for t in (0, 10, 20)], 1)
    assert known.shape[1] == len(flight[0]) - 5  # the first batch comes short
    settled = flight[:, :25]
    assert known["agents", "action"].equal(settled["agents", "action"])
    sent, steps = settled["next", "agents", "message"], settled["next", "step_count"].squeeze(-1)
    truth = server(Messages.unpack(sent), steps)
    assert known["next", "agents", "global_observation"].equal(truth.global_observation)
    assert not known["next", "agents", "global_observation"].equal(
        settled["next", "agents", "global_observation"]
    )


def test_what_was_corrected_is_reported_with_the_losses():
    learner, batch = collected_late("discrete", recompute_actor=False)
    share = learner.backupdated_batch(batch)["agents", "backupdated"].float().mean().item()
    learner, batch = collected_late("discrete", recompute_actor=False)
    losses = learner.learn(batch)
    assert losses["backupdated"] == share
    assert {"loss_objective", "loss_entropy", "loss_critic"} < set(losses)
    learner.buffer = None
    assert "backupdated" not in learner.learn(batch)
