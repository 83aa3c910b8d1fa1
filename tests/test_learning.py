"""Models, losses and metrics: what is learnt from, by whom, and what is measured."""

import math

import pytest
import torch
from damian.mappo import MappoConfig, add_advantages, losses_of, mappo_loss
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian.actions import ActionConfig
from damian.env import UavEnv
from damian.errors import InputError
from damian.metrics import EpisodeLog, Evaluation, evaluate
from damian.models import ModelConfig, make_actor, make_critic, random_policy
from damian.rewards import EpisodeConfig, RewardConfig
from damian.runs import MetricsLog, read_metrics, results_table
from damian.scenario import RegionConfig, ScenarioConfig
from damian.world.motion import MotionConfig

SMALL = ModelConfig(hidden=[16])


def scenario(**changes) -> ScenarioConfig:
    region = RegionConfig(min_area=20_000, max_area=40_000, situations=16)
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
    config = scenario(
        motion=MotionConfig(kind=motion),
        actions=ActionConfig(kind=kind),
        task=RewardConfig(spotted=1.0, source_distance=1.0),
    )
    env = UavEnv(config, 8)
    actor, critic = make_actor(env, SMALL), make_critic(env, SMALL)
    batch = env.rollout(24, actor, break_when_any_done=False)
    return batch, mappo_loss(actor, critic, MappoConfig())


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_nothing_is_learnt_from_actions_that_were_none(kind):
    batch, loss = collected("polynomial", kind)
    add_advantages(batch, loss, MappoConfig())
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
        add_advantages(batch, loss, MappoConfig())
        loss.zero_grad()
        sum(losses_of(batch.reshape(-1), loss).values()).backward()
        grads = {n: p.grad.abs().sum().item() for n, p in loss.named_parameters() if p.grad is not None}
        actors = sum(g for n, g in grads.items() if n.startswith("actor"))
        return actors, sum(grads.values()) - actors

    actor_moves, critic_moves = gradients(ready=True)
    assert actor_moves > 0
    assert critic_moves > 0
    assert gradients(ready=False)[0] == 0
    assert gradients(ready=False)[1] > 0


def test_advantages_are_scaled_over_decisions_only():
    batch, loss = collected("polynomial", "discrete")
    add_advantages(batch, loss, MappoConfig())
    advantage = batch["agents", "advantage"][batch["agents", "ready"]]
    assert advantage.mean().item() == pytest.approx(0, abs=1e-5)
    assert advantage.std(correction=0).item() == pytest.approx(1, abs=1e-4)


def test_advantages_are_the_generalised_estimate_of_each_uav():
    config = MappoConfig(gamma=0.9, lmbda=0.8, normalize_advantage=False)
    batch, loss = collected("instant", "discrete")
    loss.make_value_estimator(loss.value_type, gamma=0.9, lmbda=0.8)
    add_advantages(batch, loss, config)
    value = batch["agents", "state_value"].squeeze(-1)
    after = batch["next", "agents", "state_value"].squeeze(-1)
    reward = batch["next", "agents", "reward"].squeeze(-1)
    ends, dones = batch["next", "terminated"].float(), batch["next", "done"].float()
    estimate, expected = torch.zeros(8, 3), torch.zeros_like(value)
    for t in reversed(range(24)):
        delta = reward[:, t] + 0.9 * after[:, t] * (1 - ends[:, t]) - value[:, t]
        estimate = delta + 0.9 * 0.8 * (1 - dones[:, t]) * estimate
        expected[:, t] = estimate
    assert torch.allclose(batch["agents", "advantage"].squeeze(-1), expected, atol=1e-5)


def test_the_critic_alone_sees_global_features_under_ctde():
    config = scenario()
    config.observation.ctde = True
    env = UavEnv(config, 2)
    assert env.observation_spec["agents", "observation"].shape[-1] == 1
    assert env.observation_spec["agents", "global_observation"].shape[-1] == 4
    config.observation.ctde = False
    env = UavEnv(config, 2)
    assert env.observation_spec["agents", "observation"].shape[-1] == 4


def scripted(batch: int, done_at: list[int], success: list[bool], horizon: int) -> TensorDict:
    """A batch in which world b ends at step done_at[b], again and again."""
    done = torch.zeros(batch, horizon, 1, dtype=torch.bool)
    for b, t in enumerate(done_at):
        done[b, t - 1 :: t] = True
    won = done & torch.tensor(success).view(-1, 1, 1)
    reward = torch.arange(1.0, horizon + 1).view(1, -1, 1, 1).expand(batch, horizon, 2, 1)
    return TensorDict(
        {"next": {"done": done, "success": won, "agents": {"reward": reward}}}, [batch, horizon]
    )


def test_an_evaluation_counts_the_first_episode_of_each_world_only():
    class Script(UavEnv):
        def rollout(self, *_, **__):
            return scripted(3, [2, 5, 9], [True, False, True], 6)

    row = evaluate(Script(scenario(), 3), TensorDictModule(lambda x: x, ["a"], ["b"]), 6)
    assert row.episodes == 3
    assert row.steps == pytest.approx((2 + 5 + 6) / 3)  # the third is cut at the horizon
    assert row.success_rate == pytest.approx(1 / 3)
    assert row.episode_return == pytest.approx((3 + 15 + 21) / 3)


def test_the_episode_log_means_what_a_loop_over_episodes_means():
    config = scenario(episode=EpisodeConfig(max_steps=7, success_share=0.3))
    env = TransformedEnv(
        UavEnv(config, 16),
        Compose(RewardSum([("agents", "reward")], [("agents", "episode_reward")]), StepCounter()),
    )
    batch, log = env.rollout(40, break_when_any_done=False), EpisodeLog(window=10_000)
    log.add(batch)
    returns, wins, lengths = [], [], []
    for world in batch:
        total, steps = 0.0, 0
        for step in world:
            total += step["next", "agents", "reward"].mean().item()
            steps += 1
            if step["next", "done"].item():
                returns.append(total)
                wins.append(step["next", "success"].item())
                lengths.append(steps)
                total, steps = 0.0, 0
    means = log.means()
    assert log.finished == len(returns) > 0
    assert 0 < means["success_rate"] < 1
    assert means["episode_return"] == pytest.approx(sum(returns) / len(returns), abs=1e-5)
    assert means["success_rate"] == pytest.approx(sum(wins) / len(wins))
    assert means["steps"] == pytest.approx(sum(lengths) / len(lengths))


def test_an_episode_log_survives_a_checkpoint():
    log, restored = EpisodeLog(), EpisodeLog()
    assert math.isnan(log.means()["steps"])
    log.finished = 1
    log._recent.append((1.0, 0.0, 5.0))
    restored.load_state_dict(log.state_dict())
    assert restored.means() == log.means()
    assert restored.finished == 1


def test_a_spoilt_metrics_file_is_one_clear_line(tmp_path):
    log = MetricsLog(tmp_path, tensorboard=False, to_csv=True)
    log.add(10, {"steps": 2.0})
    assert read_metrics(tmp_path) == [{"frames": 10.0, "steps": 2.0}]
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write("20,many\n")
    with pytest.raises(InputError, match=r"metrics\.csv, line 3: not a row of numbers"):
        read_metrics(tmp_path)


def test_a_task_without_success_shows_none():
    row = {"random": Evaluation(4, 0.0, 50.0, 1.5)}
    assert "| random | - | 50.00 | 1.500 | 4 |" in results_table(row, can_succeed=False)
    assert "| random | 0.00 | 50.00 | 1.500 | 4 |" in results_table(row, can_succeed=True)
