"""Recurrent actors: hidden states in flight, their recomputation in training, and what memory is good for."""

import itertools
from collections.abc import Iterator

import pytest
import torch
from helpers import check_refused, everything, learning
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Categorical, Composite, TensorDictReplayBuffer, Unbounded
from torchrl.envs import EnvBase, StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian.delays.config import DelayConfig
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.keys import HIDDEN, HIDDEN_BEFORE
from damian.learners.mappo import Mappo, MappoConfig, policy_terms
from damian.learners.networks import ModelConfig, make_actor
from damian.learners.recurrent import add_recurrent_state
from damian.recipes import evaluate as evaluate_recipe
from damian.recipes import oracle, train
from damian.recipes.shared.collecting import make_collector
from damian.replay.backupdate import BackupdateStorage
from damian.replay.recompute import server_recompute
from damian.runs.metrics import evaluate
from damian.runs.run_folder import CHECKPOINT
from damian.server.termination import EpisodeConfig

GRU = ModelConfig(hidden=[16, 8], rnn="gru")
ROUNDING = 1e-5
"""Largest difference between numbers that are computed step by step and in one batch."""
OBSERVATION, ACTION = (("agents", name) for name in ("observation", "action"))
ADVANTAGE = ("agents", "advantage")

both_kinds_and_motions = pytest.mark.parametrize(
    ("kind", "motion"), [("discrete", "instant"), ("continuous", "instant"), ("discrete", "polynomial")]
)


def delayed_env(kind: str = "discrete", motion: str = "instant", worlds: int = 4, **changed) -> DelayedEnv:
    """An environment with late messages, and episodes of 9 steps."""
    delay = DelayConfig(obs={"law": "uniform", "low": 0, "high": 5})
    scenario = everything(motion, kind, **({"delay": delay, "episode": EpisodeConfig(max_steps=9)} | changed))
    env = make_env(scenario, worlds, seed=1, extras=["message"])
    env.append_transform(StepCounter())
    return env


def batches(env: EnvBase, actor: torch.nn.Module, steps: int, n: int) -> Iterator[TensorDictBase]:
    """Collect n consecutive batches [B, T]."""
    collector = make_collector(env, actor, env.batch_size.numel() * steps)
    yield from (batch.clone() for batch in itertools.islice(collector, n))
    collector.shutdown()


def ratios(learner: Mappo, batch: TensorDictBase) -> torch.Tensor:
    """Importance ratios in the loss, [B, T, N]."""
    return policy_terms(batch.clone(), learner.actor)[0].detach().exp()


@both_kinds_and_motions
def test_hidden_states_are_carried_from_step_to_step_and_start_from_zeros(kind, motion):
    env = delayed_env(kind, motion)
    actor = make_actor(env, GRU)
    collected = torch.cat([*batches(env, actor, 7, 3)], 1)
    begins = collected["is_init"].squeeze(-1)
    assert begins.equal(collected["step_count"].squeeze(-1) == 0)
    assert begins[:, 1:].any()
    assert not begins[:, [7, 14]].all()  # some hidden states are carried from one batch to the next
    before, after = collected[HIDDEN_BEFORE], collected[HIDDEN]
    assert (before[begins] == 0).all()
    assert before[:, 1:][~begins[:, 1:]].equal(after[:, :-1][~begins[:, 1:]])
    assert (after != before).any(-1).all()


@both_kinds_and_motions
def test_the_first_importance_ratios_are_one_in_every_batch(kind, motion):
    env = delayed_env(kind, motion)
    learner = Mappo(env, MappoConfig(), learning(GRU))
    for batch in batches(env, learner.actor, 7, 3):
        assert (ratios(learner, batch) - 1).abs().max() < ROUNDING
        minibatch = batch[torch.tensor([2, 0])]
        assert (ratios(learner, minibatch) - 1).abs().max() < ROUNDING


@pytest.mark.parametrize("zeroed", [HIDDEN_BEFORE, "is_init"])
def test_recomputation_needs_the_first_hidden_state_and_the_beginnings_of_episodes(zeroed):
    env = delayed_env()
    learner = Mappo(env, MappoConfig(), learning(GRU))
    _, batch = batches(env, learner.actor, 14, 2)
    batch[zeroed] = torch.zeros_like(batch[zeroed])
    assert (ratios(learner, batch) - 1).abs().max() > 100 * ROUNDING


def test_training_reads_no_hidden_state_of_a_batch_but_the_first():
    env = delayed_env()
    learner = Mappo(env, MappoConfig(), learning(GRU))
    _, batch = batches(env, learner.actor, 14, 2)
    batch[HIDDEN].fill_(torch.nan)
    batch[HIDDEN_BEFORE][:, 1:] = torch.nan
    assert (ratios(learner, batch) - 1).abs().max() < ROUNDING


def test_an_update_learns_from_whole_sequences():
    env = delayed_env()
    learner = Mappo(env, MappoConfig(epochs=1, minibatches=1), learning(GRU))
    _, batch = batches(env, learner.actor, 14, 2)
    losses = learner.learn(batch)
    assert abs(losses["loss_objective"]) < ROUNDING  # ratios of 1, and advantages of mean 0
    assert all(weight.grad.abs().max() > 0 for weight in learner.weights)


def test_two_minibatches_split_the_worlds_in_halves():
    env = delayed_env()
    learner = Mappo(
        env, MappoConfig(epochs=1, minibatches=2, lr=1e-9, normalize_advantage=False), learning(GRU)
    )
    (batch,) = batches(env, learner.actor, 14, 1)
    losses = learner.learn(batch)
    ready = batch["agents", "ready"]
    torch.manual_seed(0)
    halves = [batch[ADVANTAGE].squeeze(-1)[i][ready[i]].mean() for i in torch.randperm(4).tensor_split(2)]
    assert abs(losses["loss_objective"] + sum(halves) / 2) < ROUNDING


@pytest.mark.parametrize("settle", [0, 5])
def test_a_batch_from_the_replay_buffer_keeps_its_first_hidden_state(settle):
    env = delayed_env()
    recompute = server_recompute(env.server)
    buffer = TensorDictReplayBuffer(storage=BackupdateStorage(40 * 4, recompute, longest=5))
    learner = Mappo(env, MappoConfig(), learning(GRU, settle), buffer)
    parts = [*batches(env, learner.actor, 10, 3)]
    flight, begin = torch.cat(parts, 1), 0
    for batch in parts:
        corrected = learner.backupdated_batch(batch)
        flown = flight[:, begin : begin + corrected.shape[1]]
        assert corrected[HIDDEN_BEFORE].equal(flown[HIDDEN_BEFORE])
        assert corrected[OBSERVATION].equal(flown[OBSERVATION])
        assert (ratios(learner, corrected) - 1).abs().max() < ROUNDING
        begin += corrected.shape[1]
    assert begin == 30 - settle
    assert corrected["agents", "backupdated"].any()
    assert (corrected[HIDDEN_BEFORE][:, 0] != 0).any()


def test_gradients_reach_back_to_the_beginning_of_the_episode_and_no_further():
    gru = make_actor(delayed_env(), GRU).module[0][0]
    features, begins = torch.rand(2, 6, 3, 16, requires_grad=True), torch.zeros(2, 6, 1, dtype=torch.bool)
    begins[0, 2] = True  # in one of two worlds
    gru.replay(features, torch.rand(2, 3, 8), begins)[:, -1].sum().backward()
    has_gradient = (features.grad != 0).any(-1).all(-1)
    assert has_gradient.tolist() == [[False] * 2 + [True] * 4, [True] * 6]
    assert (features.grad[0, :2] == 0).all()


def test_each_uav_remembers_its_own_observations_only():
    gru = make_actor(delayed_env(), GRU).module[0][0]
    agents = {"observation": torch.rand(2, 3, 8), "hidden": torch.rand(2, 3, 8)}
    gru.encoder, other = torch.nn.Linear(8, 16), {key: value.clone() for key, value in agents.items()}
    other["observation"][:, 1] += 1
    other["hidden"][:, 2] += 1
    one, another = (gru(TensorDict({"agents": entries}, [2]))[HIDDEN] for entries in (agents, other))
    assert one[:, 0].equal(another[:, 0])
    assert (one[:, 1:] != another[:, 1:]).any(-1).all()


def test_hidden_states_are_added_to_an_environment_once_and_only_for_a_recurrent_policy():
    env = delayed_env()
    before = len(env.transform)
    add_recurrent_state(env, make_actor(env, ModelConfig(hidden=[8])))
    assert len(env.transform) == before
    actor = make_actor(env, GRU)
    for _ in range(2):
        add_recurrent_state(env, actor)
        assert len(env.transform) == before + 2
    assert {HIDDEN, "is_init"} <= set(env.observation_spec.keys(True, True))


def test_an_evaluation_carries_hidden_states_and_starts_from_zeros():
    env = delayed_env()
    actor = make_actor(env, ModelConfig(hidden=[8], rnn="gru"))
    with torch.no_grad():
        for weight in actor.parameters():
            weight.mul_(4)  # so that actions depend on the hidden states
    first = evaluate(env, actor, 9, sample=False)
    env.set_seed(1)
    assert evaluate(env, actor, 9, sample=False) == first
    carried, forgotten = (return_by_hand(delayed_env(), actor, forgets) for forgets in (False, True))
    assert first.perceived_return == pytest.approx(carried, rel=1e-6)
    assert carried != pytest.approx(forgotten, rel=1e-3)


@torch.no_grad()
def return_by_hand(env: DelayedEnv, actor: torch.nn.Module, forgets: bool) -> float:
    """Mean return of the first episodes, with hidden states kept outside of the environment."""
    env.set_seed(1)
    step, total, running = env.reset(), 0.0, torch.ones(4, 1)
    hidden = torch.zeros(4, 3, 8)
    for _ in range(9):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            chosen = actor(step.clone().set(HIDDEN, hidden * (not forgets)))
        hidden, next_step = chosen[HIDDEN], env.step(step.set(ACTION, chosen[ACTION]))["next"]
        total += (next_step["agents", "reward"].squeeze(-1) * running).mean().item()
        running, step = running * ~next_step["done"], next_step
    return total


class Recall(EnvBase):
    """Each of two agents observes a bit at the reset, and is rewarded for repeating it three steps later."""

    def __init__(self, worlds: int) -> None:
        super().__init__(batch_size=[worlds])
        shape, self.bit, self.elapsed = (worlds, 2), torch.zeros(worlds, 2), torch.zeros(worlds, 1)
        observation = Unbounded((*shape, 1))
        agents = {
            "observation": observation,
            "global_observation": observation.clone(),
            "ready": Binary(2, shape, dtype=bool),
        }
        self.observation_spec = Composite(agents=Composite(agents, shape=shape), shape=[worlds])
        self.action_spec = Composite(
            agents=Composite(action=Categorical(2, shape), shape=shape), shape=[worlds]
        )
        self.reward_spec = Composite(
            agents=Composite(reward=Unbounded((*shape, 1)), shape=shape), shape=[worlds]
        )

    def outputs(self, bit: torch.Tensor, **more: torch.Tensor) -> TensorDict:
        agents = {"observation": bit.unsqueeze(-1), "ready": torch.ones_like(bit, dtype=torch.bool)}
        agents["global_observation"] = agents["observation"].clone()
        return TensorDict({"agents": TensorDict(agents | more, bit.shape)}, self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None, **_) -> TensorDictBase:
        begins = torch.ones_like(self.elapsed, dtype=torch.bool)
        begins = begins if tensordict is None else tensordict.get("_reset", begins)
        fresh = 2.0 * torch.randint(2, self.bit.shape) - 1
        self.bit, self.elapsed = torch.where(begins, fresh, self.bit), self.elapsed * ~begins
        return self.outputs(self.bit)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.elapsed += 1
        done = self.elapsed == 4
        right = (2 * tensordict[ACTION] - 1 == self.bit) & done
        outputs = self.outputs(torch.zeros_like(self.bit), reward=right.float().unsqueeze(-1))
        return outputs.update({"done": done, "terminated": done.clone()})

    def _set_seed(self, seed: int | None) -> None: ...


@pytest.mark.parametrize("rnn", ["none", "gru"])
def test_only_a_recurrent_actor_learns_to_repeat_an_earlier_observation(rnn):
    env = TransformedEnv(Recall(64))
    config = MappoConfig(lr=1e-2, gamma=1.0, minibatches=2)
    learner = Mappo(env, config, learning(ModelConfig(hidden=[16], rnn=rnn)))
    for batch in batches(env, learner.actor, 6, 20):
        learner.learn(batch)
    add_recurrent_state(env, learner.actor)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout = env.rollout(20, learner.actor, break_when_any_done=False)
    right = rollout["next", "agents", "reward"][:, 3::4].mean().item()
    assert right == 1.0 if rnn == "gru" else abs(right - 0.5) < 0.1


# The recipes.

TINY = ["frames=256", "worlds=8", "learner.steps=16", "eval_episodes=4", "model.hidden=[16]", "logger=csv"]
TINY += ["region.lattice_step=60", "episode.max_steps=12"]  # quick to rank and to evaluate


@pytest.mark.parametrize(
    "overrides",
    [
        ["actions=continuous"],
        ["motion=polynomial", "delay=paper", "aware=both", "settle=true"],
    ],
)
@pytest.mark.slow
def test_the_recipe_trains_recurrent_actors(run, overrides):
    folder = run(train, "model=gru", *TINY, *overrides)
    assert len((folder / "metrics.csv").read_text().splitlines()) == 3
    assert (folder / "result.csv").exists()


@pytest.mark.slow
def test_a_recurrent_actor_flies_more_uavs_and_the_oracle_and_its_training_resumes(run, tmp_path):
    overrides = ["model=gru", *TINY, "delay.obs=2", "aware=both", "episode.max_steps=10"]
    trained = run(train, *overrides, folder="trained")
    for recipe, agents in ((evaluate_recipe, 10), (oracle, 3)):
        folder = run(recipe, f"checkpoint={trained}", f"agents={agents}", folder=f"flown_{agents}")
        assert (folder / "result.csv").exists()
    run(train, f"resume={trained}", "frames=384", folder="unused")
    assert len((trained / "metrics.csv").read_text().splitlines()) == 4
    assert (trained / CHECKPOINT).exists()


@pytest.mark.parametrize(
    ("overrides", "error"),
    [
        (["model.rnn=lstm"], "model.rnn: lstm is not one of none, gru"),
        (["model=gru", "model.hidden=[]"], "model.hidden: [] needs at least one layer for model.rnn=gru"),
        (["model=gru", "learner=sac"], "model.rnn: gru is for learner=mappo only"),
        (["model=gru", "worlds=3"], "learner.minibatches: 4 is not between 1 and 3"),
        (
            ["model=gru", "delay=paper", "backupdate=true", "recompute_actor=true"],
            "recompute_actor: True does not go with model.rnn",
        ),
    ],
)
def test_settings_that_do_not_fit_are_refused_in_one_line(run, capsys, tmp_path, overrides, error):
    check_refused(lambda: run(train, *overrides), error, capsys)
    assert list(tmp_path.iterdir()) == []
