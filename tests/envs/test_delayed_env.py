"""A scenario with its delays and clocks: the invariants that hold whatever is late."""

import copy
import math
import pickle
from collections.abc import Sequence
from functools import partial
from typing import Any

import pytest
import torch
from helpers import KEEPS_GOING, all_same, both_kinds, both_motions, everything, play, random_actions, square
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import (
    Compose,
    EnvBase,
    GymEnv,
    ParallelEnv,
    RewardSum,
    StepCounter,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from damian.delays.config import DelayConfig
from damian.delays.laws import law_of
from damian.envs.clocks import ClockConfig
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import hold_action, make_env, make_transforms, server_transforms
from damian.envs.scenario import ScenarioConfig
from damian.envs.uav_env import EXTRAS, UavEnv
from damian.keys import ACTION, AGE, GLOBAL_OBSERVATION, MESSAGE, OBSERVATION, READY, RECEIVED, REWARD
from damian.server.termination import EpisodeConfig
from damian.transforms import ActionDelay, CumulativeReward, RewardDelay, SampleAndHold
from damian.world.messages import Messages
from damian.world.signal_source import SourceConfig

PAPER = {"law": "uniform", "low": "3s", "high": "7s", "probability": 0.15}
BURST = {"law": "burst", "enter": 0.2, "leave": 0.3, "bad": 4, "bad_loss": 0.3}
DELAYS = {
    "paper": {"delay": DelayConfig(obs=PAPER)},
    "burst": {"delay": DelayConfig(obs=BURST, act={"law": "geometric", "mean": 1}, order="arrival")},
    "everything": {"delay": DelayConfig(obs=3, act=2, rew=1, history=4, loss=0.1, reward_window=3)},
    "slow clocks": {
        "delay": DelayConfig(obs=PAPER, act={"law": "uniform", "high": 2}, history=2),
        "clock": ClockConfig(agents="2s", server="4s"),
    },
}
late = pytest.mark.parametrize("late", DELAYS)


def delayed(scenario: ScenarioConfig, n_worlds: int = 4, **options: Any) -> EnvBase:
    return make_env(scenario, n_worlds, extras=EXTRAS, **options)


def choices(env: EnvBase, n_steps: int) -> list[Tensor]:
    """Random actions, the same at each call."""
    generator = torch.Generator().manual_seed(3)
    return [random_actions(env, generator) for _ in range(n_steps)]


def over_time(shown: Sequence[TensorDictBase], key: Any) -> Tensor:
    """An entry as each step showed it, [T, B, ...]."""
    return torch.stack([td[key] for td in shown[1::2]])


# Without delays.


def by_hand(scenario: ScenarioConfig, n_worlds: int) -> DelayedEnv:
    """The whole chain, although nothing is late."""
    env = UavEnv(scenario, n_worlds, extras=EXTRAS, messages_only=True)
    keys = {"sent_key": "ready", "valid_key": "action_valid"}
    chain = [
        ActionDelay(0, ACTION, default=hold_action(scenario.actions), **keys),
        *server_transforms(scenario, env.server, EXTRAS),
        RewardDelay(0, REWARD),
        CumulativeReward(1, 0.9, REWARD),
        SampleAndHold(1, [OBSERVATION, GLOBAL_OBSERVATION]),
        SampleAndHold(1, [OBSERVATION], ready_key=READY),
    ]
    chained = DelayedEnv(env, Compose(*chain))
    chained.set_seed(0)
    return chained


def check_as_bare(env: EnvBase, scenario: ScenarioConfig, n_steps: int = 25) -> None:
    """Everything that the bare environment shows is shown, bit for bit."""
    bare = UavEnv(scenario, env.batch_size[0])
    plain, shown = play(bare, choices(bare, n_steps)), play(env, choices(bare, n_steps))
    assert all_same([td.select(*plain[1].keys(True, True), strict=False) for td in shown], plain)
    assert sum(td["done"].sum() for td in plain) > 0


@both_kinds
@both_motions
def test_the_server_node_with_what_was_just_sent_does_what_the_bare_environment_does(motion, kind):
    scenario = everything(motion, kind)
    check_as_bare(by_hand(scenario, 8), scenario)


@both_motions
def test_the_server_node_ends_an_episode_with_the_walk_of_the_source(motion):
    episode = EpisodeConfig(max_steps=None, end_with_source=True)
    source = SourceConfig(motion="dynamic", min_wait=0.5, max_wait=1.0, n_hotspots=1, local_distance=5.0)
    scenario = everything(motion, source=source, episode=episode)
    check_as_bare(by_hand(scenario, 4), scenario, 60)


@both_motions
def test_the_server_node_knows_the_length_of_a_step(motion):
    scenario = everything(motion, clock=ClockConfig("0.1m"))
    check_as_bare(by_hand(scenario, 4), scenario)


@both_motions
def test_a_law_that_delays_nothing_changes_nothing(motion):
    never = {"law": "burst", "good": 0, "bad": 0, "bad_loss": 0.0}
    bare = everything(motion)
    env = delayed(everything(motion, delay=DelayConfig(obs=never, act=never, rew=never)), 8)
    assert isinstance(env, DelayedEnv)
    check_as_bare(env, bare)


def test_where_nothing_is_late_there_is_no_chain():
    nothing = DelayConfig(obs="0s", act={"law": "uniform", "high": "7s", "low": "3s", "probability": 0.0})
    env = make_env(everything(delay=nothing), 4, extras=EXTRAS)
    assert not [*env.transform.transforms]
    check_as_bare(env, everything())


# TorchRL's contract.


@late
@both_kinds
@both_motions
def test_every_delay_keeps_the_specs(late, motion, kind):
    env = delayed(everything(motion, kind, **DELAYS[late]), 2)
    check_env_specs(env, seed=0, break_when_any_done="both")


@late
def test_without_extras_the_specs_are_kept_and_no_message_is_shown(late):
    env = make_env(everything(**DELAYS[late]), 2)
    check_env_specs(env, seed=0, break_when_any_done="both")
    assert not {"message", "received", "age", "delay", "message_sent"} & set(env.reset()["agents"].keys())


# No peeking.


class Liar(Transform):
    """Changes the position in the message that one UAV sends in one step, for whoever stands behind it."""

    def __init__(self, world: int, agent: int, step: int) -> None:
        super().__init__()
        self.who, self.when, self.steps = (world, agent), step, 0

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.steps += 1
        if self.steps == self.when:
            message = next_tensordict[MESSAGE].clone()
            message[self.who] = message[self.who] - torch.eye(message.shape[-1])[1] * 7
            next_tensordict.set(MESSAGE, message)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset


@pytest.mark.parametrize("order", ["generation", "arrival"])
@pytest.mark.parametrize("obs", [4, {"law": "geometric", "mean": 3}], ids=["constant", "random"])
def test_what_a_message_says_reaches_nobody_before_it_arrives(obs, order):
    scenario = everything(episode=KEEPS_GOING, delay=DelayConfig(obs=obs, order=order))
    honest = play(env := delayed(scenario), choices(env, 20))
    believed = 0
    for world, agent, sent in ((0, 0, 3), (1, 2, 8), (3, 1, 11)):
        env = delayed(scenario)
        env.insert_transform(0, Liar(world, agent, sent))
        lied = play(env, choices(env, 20))
        delay = int(over_time(honest, ("agents", "delay"))[sent - 1, world, agent])
        before = 2 * (sent + delay) - 1
        seen = [td.exclude(MESSAGE) for td in honest], [td.exclude(MESSAGE) for td in lied]
        assert all_same(seen[0][:before], seen[1][:before])
        others = torch.arange(4) != world
        assert all_same([td[others] for td in honest], [td[others] for td in lied])
        at = honest[before], lied[before]
        if at[0][AGE][world, agent] == delay:
            believed += 1
            assert not at[0][RECEIVED][world, agent].equal(at[1][RECEIVED][world, agent])
            assert not at[0][GLOBAL_OBSERVATION][world].equal(at[1][GLOBAL_OBSERVATION][world])
    assert believed >= 1


def test_a_choice_changes_nothing_before_it_is_executed():
    scenario = square(episode=KEEPS_GOING, delay=DelayConfig(act=3))
    env = delayed(scenario)
    one, other = choices(env, 12), choices(env, 12)
    other[4] = (other[4] + 11) % scenario.actions.n_actions
    some, others = (over_time(play(delayed(scenario), actions), "state") for actions in (one, other))
    assert some[:7].equal(others[:7])
    assert not some[7].equal(others[7])


# Batches.


@late
@both_motions
def test_worlds_stepped_together_do_what_each_does_alone(late, motion):
    scenario, seeds = everything(motion, **DELAYS[late]), torch.tensor([11, 5])
    env = delayed(scenario, 2)
    env.seed_worlds(seeds)
    actions = choices(env, 15)
    together = play(env, actions)
    for w in range(2):
        alone = delayed(scenario, 1)
        alone.seed_worlds(seeds[w : w + 1])
        shown = play(alone, [action[w : w + 1] for action in actions])
        assert all_same([td[w : w + 1] for td in together], shown)


@late
@both_motions
def test_a_reset_of_some_worlds_touches_only_their_rows(late, motion):
    scenario = everything(motion, **DELAYS[late] | {"episode": KEEPS_GOING})

    def life(mask: Sequence[bool]) -> list[TensorDictBase]:
        env, shown = delayed(scenario), []
        td = env.reset()
        for t, action in enumerate(choices(env, 12)):
            stepped, td = env.step_and_maybe_reset(td.set(ACTION, action))
            td = td.exclude(ACTION)
            if t in (2, 4, 8) and any(mask):
                td = env.reset(td.set("_reset", torch.tensor(mask).unsqueeze(-1))).exclude("_reset")
            shown += [stepped["next"].clone(), td.clone()]
        return shown

    some, every, none = life([True, False, False, True]), life([True] * 4), life([False] * 4)
    for worlds, alike in (([1, 2], none), ([0, 3], every)):
        for w in worlds:
            assert all_same([td[w] for td in some], [td[w] for td in alike])
    assert not all_same([td[0] for td in some], [td[0] for td in none])


def test_the_same_seed_draws_the_same_delays_and_another_one_others():
    scenario = everything(**DELAYS["paper"])
    lives = [play(env := delayed(scenario, seed=seed), choices(env, 20)) for seed in (1, 1, 2)]
    assert all_same(lives[0], lives[1])
    delays = [over_time(life, ("agents", "delay")) for life in lives]
    assert not delays[0].equal(delays[2])


# Delays of actions and of observations.


@pytest.mark.parametrize("i", range(4))
@pytest.mark.parametrize("j", range(4))
def test_messages_late_by_i_and_actions_by_j_are_messages_late_by_their_sum(i, j):
    """Katsikopoulos and Engelbrecht (2003): the same life, lived j steps later."""

    def heard(td: TensorDictBase) -> Tensor:
        return td.get(RECEIVED, td[MESSAGE])

    def life(delay: DelayConfig, n_holds: int) -> tuple[Tensor, Tensor]:
        scenario = everything(episode=KEEPS_GOING, delay=delay)
        env = delayed(scenario)
        td, heards, states = env.reset(), [], []
        for t in range(12):
            action = (heard(td).abs().sum(-1) * 10).long() % scenario.actions.n_actions
            heards.append(heard(td))
            action = torch.full_like(action, hold_action(scenario.actions)) if t < n_holds else action
            td = env.step_and_maybe_reset(td.set(ACTION, action))[1]
            states.append(td["state"])
        return torch.stack(heards), torch.stack(states)

    both, summed = life(DelayConfig(obs=i, act=j), 0), life(DelayConfig(obs=i + j), j)
    assert both[0][: 12 - j].equal(summed[0][j:])
    assert both[1].equal(summed[1])
    assert len(both[1].flatten(0, 1).unique(dim=0)) > 8


# What the server holds, and how old it is.


@late
@both_motions
def test_what_the_server_holds_is_as_old_as_it_says(late, motion):
    delay = DELAYS[late]["delay"]
    env = delayed(everything(motion, delay=delay, clock=ClockConfig("2s")), 8)
    shown, dt = play(env, choices(env, 30)), env.scenario.clock.dt
    steps, old = torch.zeros(8, 1), 0
    for stepped, following in zip(shown[1::2], shown[2::2], strict=True):
        steps += 1
        for td in (stepped, following):
            age = td[AGE].squeeze(-1)
            assert Messages.unpack(td[RECEIVED]).time.equal((steps - age) * dt)
            old += (age > 1).sum().item()
            steps = steps * ~stepped["done"]  # what follows is shown after the reset
        assert following[AGE].squeeze(-1)[stepped["done"].squeeze(-1)].sum() == 0
    assert old > 15


def test_a_reset_gives_the_server_everybody_s_first_message_at_once():
    env = delayed(everything(**DELAYS["everything"]), 8)
    shown = play(env, choices(env, 30))
    begun = [shown[0]]
    for stepped, following in zip(shown[1::2], shown[2::2], strict=True):
        begun.append(following[stepped["done"].squeeze(-1)])
    assert sum(len(td) for td in begun) > 20
    for td in begun:
        assert td[RECEIVED].equal(td[MESSAGE])
        assert not td[AGE].any()
        assert not td["agents", "delay"].any()
        assert not Messages.unpack(td[RECEIVED]).time.any()


def test_where_every_message_is_lost_the_server_believes_the_first_one_for_the_whole_episode():
    env = delayed(square(episode=KEEPS_GOING, delay=DelayConfig(loss=1.0)))
    shown = play(env, choices(env, 10))
    for t, td in enumerate(shown[1::2], 1):
        assert td[RECEIVED].equal(shown[0][MESSAGE])
        assert (td[AGE] == t).all()
        assert (td["agents", "delay"] == -1).all()


SILENT = SourceConfig(emission="per_step", emission_probability=0.0)


def check_mean(rows: Tensor, exact: float) -> None:
    """Means of independent rows lie around the exact mean: four standard errors."""
    error = rows.std() / math.sqrt(len(rows))
    assert 0 < error < 0.02
    assert abs(rows.mean() - exact) < 4 * error


def test_the_paper_s_law_makes_15_percent_late_and_its_ages_are_those_of_theory():
    scenario = square(source=SILENT, episode=KEEPS_GOING, delay=DelayConfig(obs=PAPER))
    env = make_env(scenario, 512, extras=["message"])
    shown = play(env, choices(env, 150))
    delays = over_time(shown, ("agents", "delay")).double().view(150, -1)
    ages = over_time(shown, AGE).double().view(150, -1)[20:]
    check_mean((delays > 0).double().mean(0), 0.15)
    chances = law_of(PAPER).sampler().chances[0]
    older = 1 - chances.cumsum(0)[:-1]  # P(D > i)
    check_mean(ages.mean(0), older.cumprod(0).sum().item())


def test_uavs_remember_how_far_east_and_north_they_chose_to_go():
    scenario = square(delay=DelayConfig(act=2, history=2), episode=KEEPS_GOING)
    env, plain = delayed(scenario), UavEnv(square(), 4)
    actions = choices(env, 6)
    distance, heading = scenario.actions.table().unbind(-1)
    there = torch.stack([distance * heading.sin(), distance * heading.cos()], -1)
    table = (there / 200 + 1) / 2
    shown = play(env, actions)
    for t in range(2, 6):
        expected = torch.cat([table[actions[t - 1]], table[actions[t]]], -1)
        seen = shown[2 * t + 1][OBSERVATION]
        assert seen.shape[-1] == plain.observation_spec[OBSERVATION].shape[-1] + 4
        torch.testing.assert_close(seen[..., -4:], expected, rtol=0, atol=1e-6)


# Clocks.


def slow(motion: str = "instant", act: Any = 0, **clocks: str) -> ScenarioConfig:
    """Nobody hears anything, so that motions are only counted up."""
    delay = DelayConfig(obs=PAPER, act=act, history=2)
    options = {"episode": KEEPS_GOING, "delay": delay, "clock": ClockConfig(**clocks)}
    return everything(motion, source=SILENT, **options)


def test_between_two_ticks_of_their_clock_uavs_do_nothing():
    env = delayed(slow(agents="3s"))
    td, moves = env.reset(), 0
    for t, action in enumerate(choices(env, 30)):
        ticks = t % 3 == 0
        assert (td[READY] == ticks).all()
        world = env.base_env.state
        _, following = env.step_and_maybe_reset(td.clone().set(ACTION, action))
        now = env.base_env.state
        assert now.motions.equal(world.motions + ticks)
        if not ticks:
            assert now.position.equal(world.position)
            assert now.sent.trail.equal(world.sent.trail)
            assert now.track.equal(world.track)
            assert following[OBSERVATION][..., -4:].equal(td[OBSERVATION][..., -4:])  # the remembered actions
        if t % 3 < 2:
            assert following[OBSERVATION][..., :-4].equal(td[OBSERVATION][..., :-4])
        moves += (now.position != world.position).any().item()
        td = following
    assert moves > 5


def test_between_two_ticks_of_the_servers_clock_nothing_new_is_seen():
    env = delayed(slow(server="4s"))
    shown, changes = play(env, choices(env, 30)), 0
    for t, td in enumerate(shown[2::2], 1):
        before = shown[2 * t - 2]
        if t % 4:
            assert td[OBSERVATION][..., :-4].equal(before[OBSERVATION][..., :-4])
            assert td[GLOBAL_OBSERVATION].equal(before[GLOBAL_OBSERVATION])
        changes += (td[GLOBAL_OBSERVATION] != before[GLOBAL_OBSERVATION]).any().item()
    assert changes > 5


def test_a_uav_sees_what_the_server_had_broadcast_by_its_own_tick():
    fast, slowly = (delayed(slow(**clocks)) for clocks in ({}, {"agents": "4s", "server": "2s"}))
    holds = torch.full((4, 3), hold_action(fast.scenario.actions))
    raw, shown = play(fast, lambda t: holds, 20), play(slowly, lambda t: holds, 20)
    for t in range(21):
        assert shown[2 * t][GLOBAL_OBSERVATION].equal(raw[2 * (t - t % 2)][GLOBAL_OBSERVATION])
        assert shown[2 * t][OBSERVATION][..., :-4].equal(raw[2 * (t - t % 4)][OBSERVATION][..., :-4])


@pytest.mark.parametrize("act", [0, 2, {"law": "geometric", "mean": 2}], ids=["none", "2", "random"])
@pytest.mark.parametrize(
    ("motion", "agents"), [("instant", "3s"), ("polynomial", "1s"), ("polynomial", "3s")]
)
def test_an_action_chosen_while_not_ready_is_never_executed(act, motion, agents):
    delay = DelayConfig(obs=1, act=act, history=2)
    scenario = everything(motion, delay=delay, clock=ClockConfig(agents=agents))
    lives, ignored = [], 0
    for changed in (False, True):
        env = delayed(scenario)
        td, shown = env.reset(), []
        for action, other in zip(choices(env, 15), choices(env, 16)[1:], strict=True):
            ignored += (~td[READY]).sum().item()
            chosen = torch.where(td[READY] | (not changed), action, other)
            stepped, td = env.step_and_maybe_reset(td.set(ACTION, chosen))
            shown += [stepped["next"].clone(), td.exclude(ACTION)]
        lives.append(shown)
    assert all_same(*lives)
    assert ignored > 50


@both_motions
@pytest.mark.parametrize("changed", [*DELAYS.values(), {}], ids=[*DELAYS, "nothing"])
def test_a_step_at_once_does_what_each_transform_does_by_itself(motion, changed):
    scenario = everything(motion, **changed)
    whole, graph = delayed(scenario), delayed(scenario).compile(backend="eager")
    world = UavEnv(scenario, 4, extras=EXTRAS, messages_only=whole.base_env.messages_only)
    plain = TransformedEnv(world, make_transforms(scenario, world.server, EXTRAS))  # transform by transform
    for number, transform in enumerate(plain.transform):
        transform.set_seed(7919 * (number + 1))
    for env in (plain, whole, graph):
        env.append_transform(RewardSum([REWARD], [("agents", "episode_reward")]))
        env.append_transform(StepCounter())
    actions = choices(plain, 30)
    by_itself = play(plain, actions)
    assert all_same(by_itself, play(whole, actions))
    assert all_same(by_itself, play(graph, actions))


def test_only_worlds_of_uavs_compile_with_their_delays():
    with pytest.raises(TypeError, match="needs a UavEnv, not GymEnv"):
        DelayedEnv(GymEnv("Pendulum-v1"), RewardDelay(2)).compile()


# Life of a compiled environment.


def quick(**changed: Any) -> DelayedEnv:
    """Compiled, but not by much."""
    return delayed(everything("instant", **changed)).compile(backend="eager")


def test_a_copy_of_a_compiled_environment_compiles_its_own():
    env = quick(**DELAYS["paper"])
    actions = choices(env, 12)
    play(env, actions)
    twin, pickled = copy.deepcopy(env), pickle.loads(pickle.dumps(env))
    shown = play(env, actions)
    assert all_same(shown, play(twin, actions))
    assert all_same(shown, play(pickled, actions))


def test_a_transform_that_is_appended_later_is_compiled_too():
    env, plain = quick(delay=DelayConfig(rew=1)), delayed(everything("instant", delay=DelayConfig(rew=1)))
    actions = choices(env, 10)
    play(env, actions)
    for each in (env, plain):
        each.append_transform(CumulativeReward(3, 0.5, REWARD))
        each.set_seed(3)
    assert all_same(play(env, actions), play(plain, actions))


@pytest.mark.parametrize("compiles", [False, True])
def test_the_flag_of_those_who_act_reaches_the_worlds(compiles):
    env = delayed(square())
    env = env.compile(backend="eager") if compiles else env
    td = env.rand_action(env.reset())
    env.step(td.clone())
    td = env.rand_action(env.reset())
    td["agents", "action_valid"] = torch.zeros(4, 3, dtype=torch.bool)
    before = env.uav_env.state.goal.clone()
    assert env.step(td)["next", "agents", "ready"].all()
    assert env.uav_env.state.goal.equal(before)


def test_environments_that_exist_already_go_into_workers():
    envs = [make_env(square(delay=DelayConfig(obs=PAPER, act=1)), 2, seed=i) for i in range(2)]
    makers = [partial(envs.__getitem__, i) for i in range(2)]
    workers = ParallelEnv(2, makers, mp_start_method="fork")
    assert workers.rollout(4).batch_size == (2, 2, 4)
    workers.close()


def test_the_state_of_another_number_of_worlds_is_refused():
    env, other = (delayed(square(delay=DelayConfig(act=2)), n) for n in (2, 5))
    env.reset()
    other.load_state_dict(env.state_dict())
    with pytest.raises(RuntimeError, match=r"rows of \(2, 3\), but the environment has \(5, 3\)"):
        other.reset()
