"""Actors that remember: what they carry over time, what is replayed in training, what they learn by it."""

import itertools
import sys
from collections.abc import Iterator
from pathlib import Path

import evaluate as evaluate_recipe
import oracle
import pytest
import torch
import train
from helpers import check_refused, everything, learning
from shared.launch import launch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Categorical, Composite, TensorDictReplayBuffer, Unbounded
from torchrl.envs import EnvBase, StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian.delays.config import DelayConfig
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.evaluation.metrics import evaluate
from damian.evaluation.run_folder import CHECKPOINT
from damian.keys import HIDDEN, HIDDEN_BEFORE
from damian.learners.mappo import Mappo, MappoConfig, mappo_loss
from damian.learners.networks import ModelConfig, make_actor
from damian.learners.recurrent import add_recurrent_state
from damian.replay.backupdate import BackupdateStorage
from damian.replay.recompute import server_recompute
from damian.server.termination import EpisodeConfig

GRU = ModelConfig(hidden=[16, 8], rnn="gru")
ROUNDING = 1e-5
"""Of what is computed step by step, and in one batch."""
SEEN, ACTION, CHOSEN = (("agents", name) for name in ("observation", "action", "action_log_prob"))
ADVANTAGE = ("agents", "advantage")

both_kinds_and_motions = pytest.mark.parametrize(
    ("kind", "motion"), [("discrete", "instant"), ("continuous", "instant"), ("discrete", "polynomial")]
)


def late_env(kind: str = "discrete", motion: str = "instant", worlds: int = 4, **changed) -> DelayedEnv:
    """Episodes of 9 steps, with late messages."""
    late = DelayConfig(obs={"law": "uniform", "low": 0, "high": 5})
    scenario = everything(motion, kind, **({"delay": late, "episode": EpisodeConfig(max_steps=9)} | changed))
    env = make_env(scenario, worlds, seed=1, extras=["message"])
    env.append_transform(StepCounter())
    return env


def batches(env: EnvBase, actor: torch.nn.Module, steps: int, n: int) -> Iterator[TensorDictBase]:
    """So many batches [B, T] in a row."""
    collector = train.make_collector(env, actor, env.batch_size.numel() * steps)
    yield from (batch.clone() for batch in itertools.islice(collector, n))
    collector.shutdown()


def ratios(learner: Mappo, batch: TensorDictBase) -> torch.Tensor:
    """Importance ratios as the loss sees them, [B, T, N]: minus the objective, where every advantage is 1."""
    ones = torch.ones_like(batch["next", "agents", "reward"])
    made = dict.fromkeys(("advantage", "state_value", "value_target"), ones)
    batch = batch.clone().update({"agents": made})
    loss = mappo_loss(learner.actor, learner.critic, MappoConfig())
    return -loss(batch)["loss_objective"].detach()


@both_kinds_and_motions
def test_a_hidden_state_goes_on_from_step_to_step_and_begins_with_zeros(kind, motion):
    env = late_env(kind, motion)
    actor = make_actor(env, GRU)
    collected = torch.cat([*batches(env, actor, 7, 3)], 1)
    begins = collected["is_init"].squeeze(-1)
    assert begins.equal(collected["step_count"].squeeze(-1) == 0)
    assert begins[:, 1:].any()
    assert not begins[:, [7, 14]].all()  # some state is carried from one batch to the next
    before, after = collected[HIDDEN_BEFORE], collected[HIDDEN]
    assert (before[begins] == 0).all()
    assert before[:, 1:][~begins[:, 1:]].equal(after[:, :-1][~begins[:, 1:]])
    assert (after != before).any(-1).all()


@both_kinds_and_motions
def test_the_first_importance_ratios_are_one_in_every_batch(kind, motion):
    env = late_env(kind, motion)
    learner = Mappo(env, MappoConfig(), learning(GRU))
    for batch in batches(env, learner.actor, 7, 3):
        assert (ratios(learner, batch) - 1).abs().max() < ROUNDING
        some = batch[torch.tensor([2, 0])]
        assert (ratios(learner, some) - 1).abs().max() < ROUNDING


@pytest.mark.parametrize("spoilt", [HIDDEN_BEFORE, "is_init"])
def test_the_replay_needs_the_first_hidden_state_and_where_episodes_begin(spoilt):
    env = late_env()
    learner = Mappo(env, MappoConfig(), learning(GRU))
    _, batch = batches(env, learner.actor, 14, 2)
    batch[spoilt] = torch.zeros_like(batch[spoilt])
    assert (ratios(learner, batch) - 1).abs().max() > 100 * ROUNDING


def test_nothing_but_the_first_hidden_state_of_a_batch_is_taken_from_the_flight():
    env = late_env()
    learner = Mappo(env, MappoConfig(), learning(GRU))
    _, batch = batches(env, learner.actor, 14, 2)
    batch[HIDDEN].fill_(torch.nan)
    batch[HIDDEN_BEFORE][:, 1:] = torch.nan
    assert (ratios(learner, batch) - 1).abs().max() < ROUNDING


def test_an_update_learns_from_whole_sequences():
    env = late_env()
    learner = Mappo(env, MappoConfig(epochs=1, minibatches=1), learning(GRU))
    _, batch = batches(env, learner.actor, 14, 2)
    losses = learner.learn(batch)
    assert abs(losses["loss_objective"]) < ROUNDING  # ratios of 1, and advantages of mean 0
    assert all(weight.grad.abs().max() > 0 for weight in learner.loss.parameters())


def test_two_minibatches_are_two_halves_of_the_worlds():
    env = late_env()
    learner = Mappo(
        env, MappoConfig(epochs=1, minibatches=2, lr=1e-12, normalize_advantage=False), learning(GRU)
    )
    (batch,) = batches(env, learner.actor, 14, 1)
    losses = learner.learn(batch)
    ready = batch["agents", "ready"]
    torch.manual_seed(0)
    halves = [batch[ADVANTAGE].squeeze(-1)[i][ready[i]].mean() for i in torch.randperm(4).tensor_split(2)]
    assert abs(losses["loss_objective"] + sum(halves) / 2) < ROUNDING


@pytest.mark.parametrize("settle", [0, 5])
def test_a_batch_from_the_memory_begins_with_the_hidden_state_that_it_began_with(settle):
    env = late_env()
    view = server_recompute(env.server)
    memory = TensorDictReplayBuffer(storage=BackupdateStorage(40 * 4, view, longest=5))
    learner = Mappo(env, MappoConfig(), learning(GRU, settle), memory)
    parts = [*batches(env, learner.actor, 10, 3)]
    flight, at = torch.cat(parts, 1), 0
    for batch in parts:
        known = learner.backupdated_batch(batch)
        there = flight[:, at : at + known.shape[1]]
        assert known[HIDDEN_BEFORE].equal(there[HIDDEN_BEFORE])
        assert known[SEEN].equal(there[SEEN])
        assert (ratios(learner, known) - 1).abs().max() < ROUNDING
        at += known.shape[1]
    assert at == 30 - settle
    assert known["agents", "backupdated"].any()
    assert (known[HIDDEN_BEFORE][:, 0] != 0).any()


def test_what_is_learnt_reaches_back_to_the_beginning_of_an_episode_and_no_further():
    gru = make_actor(late_env(), GRU).module[0][0]
    features, begins = torch.rand(2, 6, 3, 16, requires_grad=True), torch.zeros(2, 6, 1, dtype=torch.bool)
    begins[0, 2] = True  # in one of two worlds
    gru.replay(features, torch.rand(2, 3, 8), begins)[:, -1].sum().backward()
    reached = (features.grad != 0).any(-1).all(-1)
    assert reached.tolist() == [[False] * 2 + [True] * 4, [True] * 6]
    assert (features.grad[0, :2] == 0).all()


def test_each_uav_remembers_what_it_has_seen_itself():
    gru = make_actor(late_env(), GRU).module[0][0]
    agents = {"observation": torch.rand(2, 3, 8), "hidden": torch.rand(2, 3, 8)}
    gru.encoder, other = torch.nn.Linear(8, 16), {key: value.clone() for key, value in agents.items()}
    other["observation"][:, 1] += 1
    other["hidden"][:, 2] += 1
    one, another = (gru(TensorDict({"agents": shown}, [2]))[HIDDEN] for shown in (agents, other))
    assert one[:, 0].equal(another[:, 0])
    assert (one[:, 1:] != another[:, 1:]).any(-1).all()


def test_an_environment_is_told_of_hidden_states_once_and_only_for_a_policy_that_has_any():
    env = late_env()
    before = len(env.transform)
    add_recurrent_state(env, make_actor(env, ModelConfig(hidden=[8])))
    assert len(env.transform) == before
    actor = make_actor(env, GRU)
    for _ in range(2):
        add_recurrent_state(env, actor)
        assert len(env.transform) == before + 2
    assert {HIDDEN, "is_init"} <= set(env.observation_spec.keys(True, True))


def test_an_evaluation_carries_hidden_states_and_begins_anew():
    env = late_env()
    actor = make_actor(env, ModelConfig(hidden=[8], rnn="gru"))
    with torch.no_grad():
        for weight in actor.parameters():
            weight.mul_(4)  # so that what is remembered decides
    first = evaluate(env, actor, 9, sample=False)
    env.set_seed(1)
    assert evaluate(env, actor, 9, sample=False) == first
    carried, forgotten = (by_hand(late_env(), actor, forgets) for forgets in (False, True))
    assert first.episode_return == pytest.approx(carried, rel=1e-6)
    assert carried != pytest.approx(forgotten, rel=1e-3)


@torch.no_grad()
def by_hand(env: DelayedEnv, actor: torch.nn.Module, forgets: bool) -> float:
    """Mean return of the first episodes, with hidden states kept outside of the environment."""
    env.set_seed(1)
    shown, total, going = env.reset(), 0.0, torch.ones(4, 1)
    hidden = torch.zeros(4, 3, 8)
    for _ in range(9):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            chosen = actor(shown.clone().set(HIDDEN, hidden * (not forgets)))
        hidden, after = chosen[HIDDEN], env.step(shown.set(ACTION, chosen[ACTION]))["next"]
        total += (after["agents", "reward"].squeeze(-1) * going).mean().item()
        going, shown = going * ~after["done"], after
    return total


class Recall(EnvBase):
    """Each of two agents is shown a bit, and paid for repeating it three steps later."""

    def __init__(self, worlds: int) -> None:
        super().__init__(batch_size=[worlds])
        shape, self.bit, self.elapsed = (worlds, 2), torch.zeros(worlds, 2), torch.zeros(worlds, 1)
        seen = Unbounded((*shape, 1))
        agents = {
            "observation": seen,
            "global_observation": seen.clone(),
            "ready": Binary(2, shape, dtype=bool),
        }
        self.observation_spec = Composite(agents=Composite(agents, shape=shape), shape=[worlds])
        self.action_spec = Composite(
            agents=Composite(action=Categorical(2, shape), shape=shape), shape=[worlds]
        )
        self.reward_spec = Composite(
            agents=Composite(reward=Unbounded((*shape, 1)), shape=shape), shape=[worlds]
        )

    def shown(self, seen: torch.Tensor, **more: torch.Tensor) -> TensorDict:
        agents = {"observation": seen.unsqueeze(-1), "ready": torch.ones_like(seen, dtype=torch.bool)}
        agents["global_observation"] = agents["observation"].clone()
        return TensorDict({"agents": TensorDict(agents | more, seen.shape)}, self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None, **_) -> TensorDictBase:
        begins = torch.ones_like(self.elapsed, dtype=torch.bool)
        begins = begins if tensordict is None else tensordict.get("_reset", begins)
        fresh = 2.0 * torch.randint(2, self.bit.shape) - 1
        self.bit, self.elapsed = torch.where(begins, fresh, self.bit), self.elapsed * ~begins
        return self.shown(self.bit)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.elapsed += 1
        done = self.elapsed == 4
        right = (2 * tensordict[ACTION] - 1 == self.bit) & done
        shown = self.shown(torch.zeros_like(self.bit), reward=right.float().unsqueeze(-1))
        return shown.update({"done": done, "terminated": done.clone()})

    def _set_seed(self, seed: int | None) -> None: ...


@pytest.mark.parametrize("rnn", ["none", "gru"])
def test_only_an_actor_that_remembers_learns_what_was_seen_before(rnn):
    env = TransformedEnv(Recall(64))
    config = MappoConfig(lr=1e-2, gamma=1.0, minibatches=2)
    learner = Mappo(env, config, learning(ModelConfig(hidden=[16], rnn=rnn)))
    for batch in batches(env, learner.actor, 6, 20):
        learner.learn(batch)
    add_recurrent_state(env, learner.actor)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        flown = env.rollout(20, learner.actor, break_when_any_done=False)
    right = flown["next", "agents", "reward"][:, 3::4].mean().item()
    assert right == 1.0 if rnn == "gru" else abs(right - 0.5) < 0.1


# The recipes.

TINY = ["frames=256", "worlds=8", "learner.steps=16", "eval_episodes=4", "model.hidden=[16]", "logger=csv"]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run a recipe with overrides in an empty folder; returns its run folder."""
    monkeypatch.chdir(tmp_path)

    def run_recipe(recipe, *overrides: str, folder: str = "run") -> Path:
        monkeypatch.setattr(sys, "argv", ["recipe.py", *overrides, f"hydra.run.dir={folder}"])
        launch(recipe.main)
        return tmp_path / folder

    return run_recipe


@pytest.mark.parametrize(
    "overrides",
    [
        ["actions=continuous"],
        ["motion=polynomial", "delay=paper", "aware=both", "settle=true"],
    ],
)
def test_the_recipe_trains_actors_that_remember(run, overrides):
    folder = run(train, "model=gru", *TINY, *overrides)
    assert len((folder / "metrics.csv").read_text().splitlines()) == 3
    assert (folder / "result.csv").exists()


def test_what_has_learnt_is_flown_by_more_uavs_and_by_the_oracle_and_goes_on(run, tmp_path):
    words = ["model=gru", *TINY, "delay.obs=2", "aware=both", "episode.max_steps=10"]
    trained = run(train, *words, folder="trained")
    for recipe, agents in ((evaluate_recipe, 10), (oracle, 3)):
        flown = run(recipe, f"checkpoint={trained}", f"agents={agents}", folder=f"flown_{agents}")
        assert (flown / "result.csv").exists()
    run(train, f"resume={trained}", "frames=384", folder="unused")
    assert len((trained / "metrics.csv").read_text().splitlines()) == 4
    assert (trained / CHECKPOINT).exists()


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (["model.rnn=lstm"], "model.rnn: lstm is not one of none, gru"),
        (["model=gru", "model.hidden=[]"], "model.hidden: [] is no layer to be a gru"),
        (["model=gru", "learner=sac"], "model.rnn: gru is for learner=mappo only"),
        (["model=gru", "worlds=3"], "learner.minibatches: 4 is not between 1 and 3"),
        (
            ["model=gru", "delay=paper", "backupdate=true", "recompute_actor=true"],
            "recompute_actor: True does not go with model.rnn",
        ),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(run, capsys, tmp_path, overrides, told):
    check_refused(lambda: run(train, *overrides), told, capsys)
    assert list(tmp_path.iterdir()) == []
