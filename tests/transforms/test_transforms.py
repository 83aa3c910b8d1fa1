"""The transforms on any environment: against a slow twin, and the invariants that all of them keep."""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import pytest
import torch
from delay_twin import Counting, Purse, Receiver, drawn, last_actions, looking_back
from helpers import all_same, play, same
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    TensorSpec,
    Unbounded,
)
from torchrl.envs import Compose, EnvBase, GymEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from damian.common import counter_rng
from damian.delays.laws import Burst, Geometric, Trace, Uniform
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    CumulativeReward,
    ObservationDelay,
    RewardDelay,
    SampleAndHold,
    StatefulTransform,
)

ACTION, REWARD, OBSERVATION = ("agents", "action"), ("agents", "reward"), ("agents", "observation")
WORLDS, N_AGENTS, STEPS = [3, 5, 8, 13], 2, 40
ROWS = [(world, agent) for world in range(len(WORLDS)) for agent in range(N_AGENTS)]

PAPER = Uniform("3s", "7s", 0.15)
LAWS = {
    "none": lambda _: 0,
    "constant": lambda _: 3,
    "uniform": lambda _: Uniform(1, 4),
    "paper": lambda _: PAPER,
    "geometric": lambda _: Geometric(2, 6),
    "burst": lambda _: Burst(0.2, 0.3, good=Uniform(0, 1), bad=5, bad_loss=0.0),
    "trace": lambda folder: trace(folder, 4, 0, 7, 1, 0, 2, 9, 0, 0, 3),
}
"""None of them loses anything."""


def trace(folder: Any, *delays: Any) -> Trace:
    file = folder / f"{len(delays)}.csv"
    file.write_text("\n".join(map(str, ["delay", *delays])))
    return Trace(str(file))


@pytest.fixture(params=LAWS)
def law(request, tmp_path):
    return LAWS[request.param](tmp_path)


def delayed(*transforms: StatefulTransform, worlds: Sequence[int] = WORLDS, **options: Any) -> TransformedEnv:
    """The counting worlds with transforms that draw for each world by itself."""
    for transform in transforms:
        transform.seed_worlds(torch.tensor(worlds))
    return TransformedEnv(Counting(worlds, N_AGENTS, **options), Compose(*transforms))


def streams_of(worlds: Sequence[int]) -> Tensor:
    """Random streams that the transforms of ``delayed`` draw from, [M]."""
    return counter_rng.bits(torch.tensor(worlds).unsqueeze(-1), torch.arange(N_AGENTS)).flatten()


def choices(worlds: Sequence[int] = WORLDS, n_steps: int = STEPS) -> list[Tensor]:
    """What each world's agents do, whoever is stepped beside them, [B, N] for each step."""
    names, agents = torch.tensor(worlds).unsqueeze(-1), torch.arange(N_AGENTS)
    return [counter_rng.bits(names, agents, torch.tensor([t])) % Counting.N_ACTIONS for t in range(n_steps)]


def column(shown: Sequence[TensorDictBase], *key: str) -> list:
    """An entry over time, as nested lists."""
    return torch.stack([td[key] for td in shown]).tolist()


def before(shown: Sequence[TensorDictBase], *key: str) -> list:
    """An entry as it was when each step's action was chosen."""
    return column(shown[:-1:2], *key)


def after(shown: Sequence[TensorDictBase], *key: str) -> list:
    """An entry as each step showed it."""
    return column(shown[1::2], *key)


# Against the twin.


@pytest.mark.parametrize("order", ["generation", "arrival"])
@pytest.mark.parametrize(("loss", "sent_key"), [(0.0, None), (0.25, "message_sent")])
def test_everyone_holds_the_message_that_a_loop_over_messages_says(law, order, loss, sent_key):
    options = {"loss": loss, "order": order, "sent_key": sent_key, "fresh_key": "fresh", "delay_key": "delay"}
    transform = ObservationDelay(law, [OBSERVATION], [("agents", "seen")], **options)
    shown = play(delayed(transform), choices())
    sent, message_sent = column(shown, *OBSERVATION), column(shown, "agents", "message_sent")
    told = {key: column(shown, "agents", key) for key in ("seen", "age", "fresh", "delay")}
    table = drawn(transform.sampler, streams_of(WORLDS), STEPS).tolist()
    done, lost = column(shown, "done"), transform.sampler.lost
    for row, (w, n) in enumerate(ROWS):
        receiver = Receiver(order)
        receiver.begin(0, sent[0][w][n])
        for now in range(1, STEPS + 1):
            at, reset = 2 * now - 1, 2 * now
            delay = table[now - 1][row]
            travels = delay < lost and (sent_key is None or message_sent[at][w][n])
            fresh = receiver.step(now, sent[at][w][n], delay if travels else None)
            expected = [
                receiver.holds.content,
                [now - receiver.holds.sent],
                [fresh],
                [delay if travels else -1],
            ]
            assert [told[key][at][w][n] for key in told] == expected
            if done[at][w][0]:
                receiver.begin(now, sent[reset][w][n])
                expected = [sent[reset][w][n], [0.0], [True], [0]]
            assert [told[key][reset][w][n] for key in told] == expected


@pytest.mark.parametrize(("loss", "sent_key"), [(0.0, None), (0.25, "ready")])
def test_everyone_executes_the_action_that_a_loop_over_choices_says(law, loss, sent_key):
    default = 5
    options = {"loss": loss, "sent_key": sent_key, "valid_key": "action_valid", "default": default}
    transform, chosen = ActionDelay(law, ACTION, **options), choices()
    shown = play(delayed(transform), chosen)
    ready = before(shown, "agents", "ready")
    seen, done = after(shown, *OBSERVATION), after(shown, "done")
    table = drawn(transform.sampler, streams_of(WORLDS), STEPS).tolist()
    for row, (w, n) in enumerate(ROWS):
        receiver = Receiver("generation")
        receiver.begin(0, default)
        for now in range(1, STEPS + 1):
            delay, t = table[now - 1][row], now - 1
            travels = delay < transform.sampler.lost and (sent_key is None or ready[t][w][n])
            fresh = receiver.step(now, chosen[t][w, n].item(), delay if travels else None)
            assert seen[t][w][n][5:] == [receiver.holds.content, fresh or receiver.waits]
            if done[t][w][0]:
                receiver.begin(now, default)


def test_continuous_actions_are_held_back_whole():
    chosen = [torch.stack([a / 2 - 1, a % 3 / 10], -1) for a in choices()]
    shown = play(delayed(ActionDelay(2, ACTION, default=[1.0, 0.5]), continuous=True, ends=0.0), chosen)
    executed = [(a * torch.tensor([1.0, 10.0])).round().sum(-1).tolist() for a in chosen]
    found = [[[agent[5] for agent in world] for world in step] for step in after(shown, *OBSERVATION)]
    assert found == [[[6.0] * N_AGENTS] * len(WORLDS)] * 2 + executed[:-2]


def rewards_of(shown: Sequence[TensorDictBase]) -> tuple[list, list]:
    """Rewards, and whether the episode ended with them, [T][B][N]."""
    return after(shown, *REWARD), after(shown, "done")


def test_everyone_is_paid_what_a_loop_over_debts_says_and_nothing_is_lost(law):
    transform = RewardDelay(law, REWARD)
    earned, done = rewards_of(play(Counting(WORLDS, N_AGENTS), choices()))
    paid, _ = rewards_of(play(delayed(transform), choices()))
    table = drawn(transform.sampler, streams_of(WORLDS), STEPS).tolist()
    for row, (w, n) in enumerate(ROWS):
        purse, owing = Purse(), 0.0
        for t in range(STEPS):
            reward, over = earned[t][w][n][0], done[t][w][0]
            assert paid[t][w][n][0] == purse.step(t, reward, table[t][row], over)
            owing += reward - paid[t][w][n][0]
            assert not over or owing == 0


def test_who_resets_before_the_end_of_an_episode_is_paid_nothing_of_it():
    env = delayed(RewardDelay(3, REWARD), ends=0.0)
    play(env, choices(n_steps=5))
    paid, _ = rewards_of(play(env, choices(n_steps=3)))
    assert paid == [[[[0.0]] * N_AGENTS] * len(WORLDS)] * 3


@pytest.mark.parametrize("steps", [1, 3, 8])
@pytest.mark.parametrize("gamma", [0.5, 1.0])  # exact in floats
def test_the_cumulative_reward_is_equation_4(steps, gamma):
    earned, done = rewards_of(play(Counting(WORLDS, N_AGENTS), choices()))
    found, _ = rewards_of(play(delayed(CumulativeReward(steps, gamma, REWARD)), choices()))
    for w, n in ROWS:
        episode = []
        for t in range(STEPS):
            episode.append(earned[t][w][n][0])
            assert found[t][w][n][0] == looking_back(episode, steps, gamma)
            episode = [] if done[t][w][0] else episode


@pytest.mark.parametrize("period", [1, 2, 3, 5])
def test_between_two_ticks_what_is_seen_and_done_stays_and_nobody_is_ready(period):
    chosen, raw = choices(), Counting(WORLDS, N_AGENTS)
    clock = SampleAndHold(period, [("agents", "message_sent")], [ACTION], ready_key=("agents", "ready"))
    shown, bare = play(delayed(clock), chosen), play(raw, chosen)
    ready, seen = column(shown, "agents", "ready"), column(shown, "agents", "message_sent")
    free, sent, done = (
        column(bare, *key) for key in (("agents", "ready"), ("agents", "message_sent"), ("done",))
    )
    executed = column(shown, *OBSERVATION)
    for w, n in ROWS:
        elapsed, holds, does = 0, sent[0][w][n], None
        for t in range(STEPS):
            at, reset = 2 * t + 1, 2 * t + 2
            does = chosen[t][w, n].item() if elapsed % period == 0 else does
            elapsed += 1
            ticks = elapsed % period == 0
            holds = sent[at][w][n] if ticks else holds
            expected = [holds, ticks and free[at][w][n]]
            assert [seen[at][w][n], ready[at][w][n]] == expected
            assert executed[at][w][n][5] == does
            if done[at][w][0]:
                elapsed, holds = 0, sent[reset][w][n]
                expected = [holds, free[reset][w][n]]
            assert [seen[reset][w][n], ready[reset][w][n]] == expected


@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize("recorded_key", [None, "ready"])
def test_everyone_remembers_the_actions_that_a_list_of_them_holds(steps, recorded_key):
    default, chosen = 2, choices()
    history = ActionHistory(steps, ACTION, default=default, recorded_key=recorded_key)
    shown = play(delayed(history), chosen)
    found = torch.stack([td["agents", "action_history"] for td in shown])
    ready, done = before(shown, "agents", "ready"), after(shown, "done")
    for w, n in ROWS:
        select_entries = []
        for t in range(STEPS):
            select_entries += [chosen[t][w, n].item()] * (recorded_key is None or ready[t][w][n])
            assert found[2 * t + 1, w, n].equal(
                torch.tensor(last_actions(select_entries, steps, default)) / 6
            )
            select_entries = [] if done[t][w][0] else select_entries
            assert found[2 * t + 2, w, n].equal(
                torch.tensor(last_actions(select_entries, steps, default)) / 6
            )


@pytest.mark.parametrize("recorded_key", [None, "ready"])
def test_only_actions_that_what_is_shown_cannot_know_of_are_remembered(law, recorded_key):
    default, chosen = 2, choices()
    late = ObservationDelay(law, [OBSERVATION])
    history = ActionHistory(3, ACTION, default=default, recorded_key=recorded_key, age_key="age")
    shown = play(delayed(late, history), chosen)
    found = torch.stack([td["agents", "action_history"] for td in shown])
    ages = column(shown, "agents", "age")
    ready, done = before(shown, "agents", "ready"), after(shown, "done")
    for w, n in ROWS:
        select_entries: list[tuple[int, int]] = []
        for t in range(STEPS):
            select_entries += [(t, chosen[t][w, n].item())] * (recorded_key is None or ready[t][w][n])
            latest = last_actions(select_entries, 3, (-STEPS, default))
            since = t + 1 - ages[2 * t + 1][w][n][0]  # when the message that is shown was generated
            unknown = [action if at >= since else default for at, action in latest]
            assert found[2 * t + 1, w, n].equal(torch.tensor(unknown) / 6)
            select_entries = [] if done[t][w][0] else select_entries


def test_the_actions_that_are_remembered_are_the_chosen_ones_not_the_executed():
    late, history = ActionDelay(3, ACTION), ActionHistory(1, ACTION)
    shown = play(delayed(late, history, ends=0.0), choices())
    for later, chosen in zip(shown[1::2], choices(), strict=True):
        assert later["agents", "action_history"].equal(chosen.unsqueeze(-1) / 6)


def test_actions_are_remembered_scaled_by_codes_or_behind_what_is_seen():
    codes = torch.arange(14.0).view(7, 2)
    coded = delayed(ActionHistory(2, ACTION, codes=codes, append_to=OBSERVATION), ends=0.0)
    shown, bare = play(coded, choices()), play(Counting(WORLDS, N_AGENTS, ends=0.0), choices())
    for t in range(2, STEPS):
        seen = shown[2 * t - 1][OBSERVATION]
        assert seen[..., :7].equal(bare[2 * t - 1][OBSERVATION])
        assert seen[..., 7:].equal(torch.cat([codes[choices()[t - 2]], codes[choices()[t - 1]]], -1).double())


# Environments of all kinds.


class Kind(NamedTuple):
    """An environment, and its keys."""

    make: Callable[[], EnvBase]
    observation: Any = OBSERVATION
    action: Any = ACTION
    reward: Any = REWARD
    steps: int = 30
    """Enough for an episode to end."""


def vmas(**options: Any) -> EnvBase:
    pytest.importorskip("vmas")
    from torchrl.envs.libs.vmas import VmasEnv  # noqa: PLC0415

    return VmasEnv("balance", num_envs=2, seed=0, max_steps=8, n_agents=2, **options)


def two(name: str, **options: Any) -> EnvBase:
    """Two environments of Gymnasium side by side, whose episodes end at different steps."""
    return SerialEnv(2, lambda: GymEnv(name, **options))


ROOT = ("observation", "action", "reward")
KINDS = {
    "CartPole": Kind(lambda: two("CartPole-v1"), *ROOT),
    "CartPole, numbered": Kind(lambda: two("CartPole-v1", categorical_action_encoding=True), *ROOT),
    "Pendulum": Kind(lambda: two("Pendulum-v1"), *ROOT),
    "CartPole, alone": Kind(lambda: GymEnv("CartPole-v1"), *ROOT),
    "CartPole, alone, numbered": Kind(lambda: GymEnv("CartPole-v1", categorical_action_encoding=True), *ROOT),
    "Pendulum, alone": Kind(lambda: GymEnv("Pendulum-v1"), *ROOT),
    "counting": Kind(lambda: Counting(WORLDS)),
    "counting, continuous": Kind(lambda: Counting(WORLDS, continuous=True)),
    "VMAS": Kind(lambda: vmas(continuous_actions=True), steps=10),
    "VMAS, discrete": Kind(lambda: vmas(continuous_actions=False), steps=10),
}
kinds = pytest.mark.parametrize("kind", KINDS)


def history(env: EnvBase, steps: int) -> list[TensorDictBase]:
    """Random actions, the same at each call: what was shown before and after each step."""
    torch.manual_seed(0)
    env.set_seed(0)
    td, shown = env.reset(), []
    for _ in range(steps):
        stepped, td = env.step_and_maybe_reset(env.rand_action(td))
        shown += [stepped.clone(), td.clone()]
    return shown


@cache
def bare_history(kind: str) -> list[TensorDictBase]:
    return history(KINDS[kind].make(), KINDS[kind].steps)


TRANSFORMS: dict[str, Callable[[Kind, Any], StatefulTransform]] = {
    "observation": lambda kind, law: ObservationDelay(law, [kind.observation], seed=1),
    "observation by arrival": lambda kind, law: ObservationDelay(
        law, [kind.observation], order="arrival", seed=1, fresh_key="fresh", delay_key="delay"
    ),
    "action": lambda kind, law: ActionDelay(law, kind.action, seed=1),
    "reward": lambda kind, law: RewardDelay(law, kind.reward, seed=1),
}
NOTHING = {
    "steps": lambda _: 0,
    "a time": lambda _: "0s",
    "uniform": lambda _: Uniform(0, 0, 0.5),
    "never": lambda _: Uniform("3s", "7s", 0.0),
    "geometric": lambda _: Geometric(0, 3),
    "burst": lambda _: Burst(good=0, bad=0, bad_loss=0.0),
    "trace": lambda folder: trace(folder, 0, 0, 0),
}


def check_unchanged(shown: list[TensorDictBase], bare: list[TensorDictBase]) -> None:
    """Everything that the bare environment shows is shown, bit for bit and in the same type."""
    for some, others in zip(shown, bare, strict=True):
        assert same(some.select(*others.keys(True, True)), others)
        assert all(some[key].dtype == value.dtype for key, value in others.items(True, True))


EVERY_LAW_ON_ONE = [
    (kind, nothing)
    for kind in KINDS
    for nothing in NOTHING
    if kind == "counting" or nothing in ("steps", "burst")
]


@pytest.mark.parametrize(("kind", "nothing"), EVERY_LAW_ON_ONE)
@pytest.mark.parametrize("transform", TRANSFORMS)
def test_without_a_delay_nothing_changes(kind, transform, nothing, tmp_path):
    of = KINDS[kind]
    late = TRANSFORMS[transform](of, NOTHING[nothing](tmp_path))
    check_unchanged(history(TransformedEnv(of.make(), late), of.steps), bare_history(kind))


@kinds
def test_a_clock_that_always_ticks_a_window_of_a_step_and_a_memory_change_nothing(kind):
    of = KINDS[kind]
    for transform in (
        SampleAndHold(1, [of.observation], [of.action]),
        CumulativeReward(1, 0.5, of.reward),
        ActionHistory(2, of.action),
    ):
        check_unchanged(history(TransformedEnv(of.make(), transform), of.steps), bare_history(kind))


@kinds
@pytest.mark.parametrize("law", [3, Burst(good=PAPER, bad_loss=0.0)], ids=["constant", "burst"])
def test_every_delay_keeps_the_specs_of_every_environment(kind, law):
    for make in TRANSFORMS.values():
        env = TransformedEnv(KINDS[kind].make(), make(KINDS[kind], law))
        check_env_specs(env, seed=0, break_when_any_done="both")


@kinds
def test_clocks_sums_and_memories_keep_the_specs_of_every_environment(kind):
    of = KINDS[kind]
    for transform in (
        SampleAndHold(3, [of.observation], [of.action]),
        CumulativeReward(4, 0.9, of.reward),
        ActionHistory(2, of.action),
        ActionHistory(2, of.action, append_to=of.observation),
    ):
        check_env_specs(TransformedEnv(of.make(), transform), seed=0, break_when_any_done="both")


@kinds
def test_all_of_them_together_keep_the_specs_of_every_environment(kind):
    of = KINDS[kind]
    chain = [
        ActionDelay(2, of.action),
        ObservationDelay(PAPER, [of.observation], loss=0.1, fresh_key="fresh", delay_key="delay"),
        RewardDelay(1, of.reward),
        CumulativeReward(3, 0.9, of.reward),
        SampleAndHold(2, [of.observation]),
        ActionHistory(2, of.action, append_to=of.observation),
    ]
    check_env_specs(TransformedEnv(of.make(), Compose(*chain)), seed=0, break_when_any_done="both")


# No peeking.


def differs(shown: Sequence[TensorDictBase], others: Sequence[TensorDictBase], *key: str) -> Tensor:
    """In which steps and for whom an entry is another, [T, B, N]."""
    pairs = zip(shown[1::2], others[1::2], strict=True)
    return torch.stack([(a[key] != b[key]).flatten(2).any(-1) for a, b in pairs])


def lasting(first: int, last: int, w: int, n: int, total: int) -> Tensor:
    """Only one agent's steps first <= t <= last, [T, B, N]."""
    wanted = torch.zeros(total, len(WORLDS), N_AGENTS, dtype=torch.bool)
    wanted[first - 1 : last, w, n] = True
    return wanted


@pytest.mark.parametrize("order", ["generation", "arrival"])
@pytest.mark.parametrize("name", ["constant", "uniform", "geometric", "trace"])
def test_what_a_message_says_changes_nothing_before_it_arrives(name, order, tmp_path):
    n_steps, arrived = 25, 0

    def rollout(tampered: tuple[int, int, int] | None) -> list[TensorDictBase]:
        law = LAWS[name](tmp_path)
        late = ObservationDelay(law, [OBSERVATION], order=order, delay_key="delay")
        return play(delayed(late, ends=0.0, tampered=tampered), choices(n_steps=n_steps))

    honest = rollout(None)
    for w, n, sent in ((0, 0, 3), (1, 1, 7), (3, 0, 12)):
        lied = differs(honest, rollout((w, n, sent)), *OBSERVATION)
        arrival = sent + int(honest[2 * sent - 1]["agents", "delay"][w, n])
        assert not lied[: arrival - 1].any()
        lied[:, w, n] = False
        assert not lied.any()
        arrived += differs(honest, rollout((w, n, sent)), *OBSERVATION)[arrival - 1, w, n].item()
    assert arrived > 0


def test_a_message_is_held_from_its_arrival_until_the_next_one():
    def rollout(tampered: tuple[int, int, int] | None) -> list[TensorDictBase]:
        late = ObservationDelay(4, [OBSERVATION])
        return play(delayed(late, ends=0.0, tampered=tampered), choices(n_steps=20))

    assert differs(rollout(None), rollout((2, 1, 6)), *OBSERVATION).equal(lasting(10, 10, 2, 1, 20))


def test_a_choice_changes_nothing_before_it_is_executed():
    others = choices(n_steps=20)
    others[6][2, 1] += 1  # chosen before the 7th step
    rollouts = [
        play(delayed(ActionDelay(4, ACTION), ends=0.0), action_valid)
        for action_valid in (choices(n_steps=20), others)
    ]
    assert differs(*rollouts, *OBSERVATION).equal(lasting(11, 20, 2, 1, 20))


def test_a_reward_changes_nothing_before_it_is_paid():
    def rollout(tampered: tuple[int, int, int] | None) -> list[TensorDictBase]:
        return play(delayed(RewardDelay(4, REWARD), ends=0.0, tampered=tampered), choices(n_steps=20))

    assert differs(rollout(None), rollout((2, 1, 6)), *REWARD).equal(lasting(10, 10, 2, 1, 20))


# Batches.


def chain() -> list[StatefulTransform]:
    """One of each, all of them random where they can be."""
    keys = {"fresh_key": "fresh", "delay_key": "delay"}
    return [
        ActionDelay(Geometric(1, 4), ACTION, loss=0.1, sent_key="ready"),
        ObservationDelay(
            Burst(0.2, 0.3), [OBSERVATION], [("agents", "seen")], sent_key="message_sent", **keys
        ),
        RewardDelay(PAPER, REWARD),
        CumulativeReward(3, 0.9, REWARD),
        SampleAndHold(2, [("agents", "seen")], ready_key=("agents", "ready")),
        ActionHistory(3, ACTION, append_to=("agents", "seen"), recorded_key="ready"),
    ]


def test_worlds_stepped_together_do_what_each_does_alone():
    together = play(delayed(*chain()), choices())
    assert sum(td["done"].sum().item() for td in together) > 10
    for w, world in enumerate(WORLDS):
        alone = play(delayed(*chain(), worlds=[world]), choices([world]))
        assert all_same([td[w : w + 1] for td in together], alone)


def test_a_reset_of_some_worlds_touches_only_their_rows():
    def rollout(mask: Sequence[bool]) -> list[TensorDictBase]:
        env, shown = delayed(*chain(), ends=0.0), []
        td = env.reset()
        for t, action in enumerate(choices(n_steps=30)):
            stepped, td = env.step_and_maybe_reset(td.set(ACTION, action))
            shown.append(stepped["next"].clone())
            if t in (4, 6, 15):
                td = env.reset(td.exclude(ACTION).set("_reset", torch.tensor(mask).unsqueeze(-1)))
                shown.append(td.exclude("_reset").clone())
        return shown

    some = rollout([True, False, False, True])
    every = rollout([True, True, True, True])
    none = rollout([False, False, False, False])
    for kept, renewed in (((1, 2), none), ((0, 3), every)):
        for w in kept:
            assert all_same([td[w] for td in some], [td[w] for td in renewed])
    assert not all_same([td[0] for td in some], [td[0] for td in none])


# Delays of actions and of observations.


@pytest.mark.parametrize("i", range(4))
@pytest.mark.parametrize("j", range(4))
def test_observations_late_by_i_and_actions_by_j_are_observations_late_by_their_sum(i, j):
    """Katsikopoulos and Engelbrecht (2003): the agent lives the same life, j steps later."""

    def decide(td: TensorDictBase) -> Tensor:
        return ((td[OBSERVATION] * torch.arange(1.0, 8)).sum(-1) % 7).long()

    def life(env: EnvBase, default_steps: int) -> tuple[Tensor, Tensor, Tensor]:
        td, seen, executed, rewards = env.reset(), [], [], []
        for t in range(20):
            action = torch.zeros(len(WORLDS), N_AGENTS, dtype=torch.long) if t < default_steps else decide(td)
            seen.append(td[OBSERVATION])
            stepped, td = env.step_and_maybe_reset(td.set(ACTION, action))
            executed.append(env.base_env.executed)
            rewards.append(stepped["next", *REWARD])
        return torch.stack(seen), torch.stack(executed), torch.stack(rewards)

    both = life(delayed(ActionDelay(j, ACTION), ObservationDelay(i, [OBSERVATION]), ends=0.0), 0)
    summed = life(delayed(ObservationDelay(i + j, [OBSERVATION]), ends=0.0), j)
    assert both[0][: 20 - j].equal(summed[0][j:])
    assert both[1].equal(summed[1])
    assert both[2].equal(summed[2])
    assert len(both[1].unique()) > 3


# Actions of every kind.

GROUP = (len(WORLDS), N_AGENTS)
ACTIONS = {
    "numbers": Categorical(5, shape=GROUP),
    "two numbers": MultiCategorical([3, 4], shape=(*GROUP, 2)),
    "one-hot": OneHot(4, shape=(*GROUP, 4)),
    "two one-hots": MultiOneHot([3, 4], shape=(*GROUP, 7)),
    "flags": Binary(3, shape=(*GROUP, 3)),
    "bounded": Bounded(-2.0, 2.0, shape=(*GROUP, 2)),
    "unbounded": Unbounded((*GROUP, 2)),
}


class Takes(Transform):
    """Lets an environment of numbered actions take others, which it notes."""

    def __init__(self, spec: TensorSpec) -> None:
        super().__init__(in_keys_inv=[ACTION])
        self.spec, self.taken = spec, []

    def _inv_call(self, td: TensorDictBase) -> TensorDictBase:
        self.taken.append(td[ACTION].clone())
        return td.set(ACTION, torch.zeros(GROUP, dtype=torch.long))

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        input_spec["full_action_spec"][ACTION] = self.spec
        return input_spec


@pytest.mark.parametrize("spec", ACTIONS.values(), ids=ACTIONS)
def test_actions_of_every_kind_are_delayed_and_remembered(spec):
    end = Takes(spec)
    chain = Compose(end, ActionDelay(2, ACTION), ActionHistory(2, ACTION))
    env = TransformedEnv(Counting(WORLDS, ends=0.0), chain)
    td, chosen = env.reset(), []
    for _ in range(6):
        td = env.rand_action(td)
        chosen.append(td[ACTION].clone())
        td = env.step_mdp(env.step(td))
    assert spec.is_in(end.taken[0])
    assert end.taken[0].equal(end.taken[1])
    assert all(late.equal(early) for late, early in zip(end.taken[2:], chosen, strict=False))
    shown = td["agents", "action_history"]
    assert shown.shape[-1] == 2 * (chosen[0].numel() // len(WORLDS) // N_AGENTS)
    if not isinstance(spec, Unbounded):
        assert ((shown >= 0) & (shown <= 1)).all()
    assert shown.dtype == torch.float32
