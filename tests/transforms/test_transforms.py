"""The transforms on many environments: comparisons with plain Python, and properties of all transforms."""

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
"""Delay laws that lose no message."""


def trace(folder: Any, *delays: Any) -> Trace:
    """A trace of these delays, in a file of the folder."""
    file = folder / f"{len(delays)}.csv"
    file.write_text("\n".join(map(str, ["delay", *delays])))
    return Trace(str(file))


@pytest.fixture(params=LAWS)
def law(request, tmp_path):
    return LAWS[request.param](tmp_path)


def delayed(*transforms: StatefulTransform, worlds: Sequence[int] = WORLDS, **options: Any) -> TransformedEnv:
    """A ``Counting`` environment with transforms whose draws depend on the names of the worlds."""
    for transform in transforms:
        transform.seed_worlds(torch.tensor(worlds))
    return TransformedEnv(Counting(worlds, N_AGENTS, **options), Compose(*transforms))


def streams_of(worlds: Sequence[int]) -> Tensor:
    """The random streams from which the transforms of ``delayed`` draw, [M]."""
    return counter_rng.bits(torch.tensor(worlds).unsqueeze(-1), torch.arange(N_AGENTS)).flatten()


def choices(worlds: Sequence[int] = WORLDS, n_steps: int = STEPS) -> list[Tensor]:
    """Actions for each step, [B, N]; those of a world do not depend on the other worlds."""
    names, agents = torch.tensor(worlds).unsqueeze(-1), torch.arange(N_AGENTS)
    return [counter_rng.bits(names, agents, torch.tensor([t])) % Counting.N_ACTIONS for t in range(n_steps)]


def column(outputs: Sequence[TensorDictBase], *key: str) -> list:
    """An entry of every output, as nested lists."""
    return torch.stack([td[key] for td in outputs]).tolist()


def before(outputs: Sequence[TensorDictBase], *key: str) -> list:
    """An entry before each step, as nested lists."""
    return column(outputs[:-1:2], *key)


def after(outputs: Sequence[TensorDictBase], *key: str) -> list:
    """An entry after each step, as nested lists."""
    return column(outputs[1::2], *key)


# Comparisons with the reference implementations in plain Python.


@pytest.mark.parametrize("order", ["generation", "arrival"])
@pytest.mark.parametrize(("loss", "sent_key"), [(0.0, None), (0.25, "message_sent")])
def test_every_agent_holds_the_message_that_the_reference_receiver_holds(law, order, loss, sent_key):
    options = {"loss": loss, "order": order, "sent_key": sent_key, "fresh_key": "fresh", "delay_key": "delay"}
    transform = ObservationDelay(law, [OBSERVATION], [("agents", "seen")], **options)
    outputs = play(delayed(transform), choices())
    observed, message_sent = column(outputs, *OBSERVATION), column(outputs, "agents", "message_sent")
    found = {key: column(outputs, "agents", key) for key in ("seen", "age", "fresh", "delay")}
    table = drawn(transform.sampler, streams_of(WORLDS), STEPS).tolist()
    done, lost = column(outputs, "done"), transform.sampler.lost
    for row, (w, n) in enumerate(ROWS):
        receiver = Receiver(order)
        receiver.begin(0, observed[0][w][n])
        for now in range(1, STEPS + 1):
            at, reset = 2 * now - 1, 2 * now
            delay = table[now - 1][row]
            arrives = delay < lost and (sent_key is None or message_sent[at][w][n])
            fresh = receiver.step(now, observed[at][w][n], delay if arrives else None)
            expected = [
                receiver.holds.content,
                [now - receiver.holds.sent],
                [fresh],
                [delay if arrives else -1],
            ]
            assert [found[key][at][w][n] for key in found] == expected
            if done[at][w][0]:
                receiver.begin(now, observed[reset][w][n])
                expected = [observed[reset][w][n], [0.0], [True], [0]]
            assert [found[key][reset][w][n] for key in found] == expected


@pytest.mark.parametrize(("loss", "sent_key"), [(0.0, None), (0.25, "ready")])
def test_every_agent_executes_the_action_that_the_reference_receiver_holds(law, loss, sent_key):
    default = 5
    options = {"loss": loss, "sent_key": sent_key, "valid_key": "action_valid", "default": default}
    transform, chosen = ActionDelay(law, ACTION, **options), choices()
    outputs = play(delayed(transform), chosen)
    ready = before(outputs, "agents", "ready")
    observed, done = after(outputs, *OBSERVATION), after(outputs, "done")
    table = drawn(transform.sampler, streams_of(WORLDS), STEPS).tolist()
    for row, (w, n) in enumerate(ROWS):
        receiver = Receiver("generation")
        receiver.begin(0, default)
        for now in range(1, STEPS + 1):
            delay, t = table[now - 1][row], now - 1
            arrives = delay < transform.sampler.lost and (sent_key is None or ready[t][w][n])
            fresh = receiver.step(now, chosen[t][w, n].item(), delay if arrives else None)
            assert observed[t][w][n][5:] == [receiver.holds.content, fresh or receiver.waits]
            if done[t][w][0]:
                receiver.begin(now, default)


def test_continuous_actions_are_delayed():
    chosen = [torch.stack([a / 2 - 1, a % 3 / 10], -1) for a in choices()]
    outputs = play(delayed(ActionDelay(2, ACTION, default=[1.0, 0.5]), continuous=True, ends=0.0), chosen)
    executed = [(a * torch.tensor([1.0, 10.0])).round().sum(-1).tolist() for a in chosen]
    found = [[[agent[5] for agent in world] for world in step] for step in after(outputs, *OBSERVATION)]
    assert found == [[[6.0] * N_AGENTS] * len(WORLDS)] * 2 + executed[:-2]


def rewards_of(outputs: Sequence[TensorDictBase]) -> tuple[list, list]:
    """Rewards [T][B][N][1], and flags of the ends of episodes [T][B][1], as nested lists."""
    return after(outputs, *REWARD), after(outputs, "done")


def test_every_agent_receives_the_rewards_of_the_reference_and_none_is_lost(law):
    transform = RewardDelay(law, REWARD)
    earned, done = rewards_of(play(Counting(WORLDS, N_AGENTS), choices()))
    received, _ = rewards_of(play(delayed(transform), choices()))
    table = drawn(transform.sampler, streams_of(WORLDS), STEPS).tolist()
    for row, (w, n) in enumerate(ROWS):
        purse, in_transit = Purse(), 0.0
        for t in range(STEPS):
            reward, ended = earned[t][w][n][0], done[t][w][0]
            assert received[t][w][n][0] == purse.step(t, reward, table[t][row], ended)
            in_transit += reward - received[t][w][n][0]
            assert not ended or in_transit == 0


def test_a_reset_during_an_episode_discards_its_rewards_in_transit():
    env = delayed(RewardDelay(3, REWARD), ends=0.0)
    play(env, choices(n_steps=5))
    received, _ = rewards_of(play(env, choices(n_steps=3)))
    assert received == [[[[0.0]] * N_AGENTS] * len(WORLDS)] * 3


@pytest.mark.parametrize("steps", [1, 3, 8])
@pytest.mark.parametrize("gamma", [0.5, 1.0])  # their powers are exact in floats
def test_the_cumulative_reward_equals_equation_4(steps, gamma):
    earned, done = rewards_of(play(Counting(WORLDS, N_AGENTS), choices()))
    found, _ = rewards_of(play(delayed(CumulativeReward(steps, gamma, REWARD)), choices()))
    for w, n in ROWS:
        episode = []
        for t in range(STEPS):
            episode.append(earned[t][w][n][0])
            assert found[t][w][n][0] == looking_back(episode, steps, gamma)
            episode = [] if done[t][w][0] else episode


@pytest.mark.parametrize("period", [1, 2, 3, 5])
def test_between_two_ticks_entries_and_actions_are_held_and_no_agent_is_ready(period):
    chosen = choices()
    clock = SampleAndHold(period, [("agents", "message_sent")], [ACTION], ready_key=("agents", "ready"))
    outputs, undelayed = play(delayed(clock), chosen), play(Counting(WORLDS, N_AGENTS), chosen)
    ready, held = column(outputs, "agents", "ready"), column(outputs, "agents", "message_sent")
    ready_now, sent, done = (
        column(undelayed, *key) for key in (("agents", "ready"), ("agents", "message_sent"), ("done",))
    )
    executed = column(outputs, *OBSERVATION)
    for w, n in ROWS:
        elapsed, sampled, executes = 0, sent[0][w][n], None
        for t in range(STEPS):
            at, reset = 2 * t + 1, 2 * t + 2
            executes = chosen[t][w, n].item() if elapsed % period == 0 else executes
            elapsed += 1
            ticks = elapsed % period == 0
            sampled = sent[at][w][n] if ticks else sampled
            expected = [sampled, ticks and ready_now[at][w][n]]
            assert [held[at][w][n], ready[at][w][n]] == expected
            assert executed[at][w][n][5] == executes
            if done[at][w][0]:
                elapsed, sampled = 0, sent[reset][w][n]
                expected = [sampled, ready_now[reset][w][n]]
            assert [held[reset][w][n], ready[reset][w][n]] == expected


@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize("recorded_key", [None, "ready"])
def test_the_action_history_equals_the_end_of_a_list_of_actions(steps, recorded_key):
    default, chosen = 2, choices()
    history = ActionHistory(steps, ACTION, default=default, recorded_key=recorded_key)
    outputs = play(delayed(history), chosen)
    found = torch.stack([td["agents", "action_history"] for td in outputs])
    ready, done = before(outputs, "agents", "ready"), after(outputs, "done")
    for w, n in ROWS:
        recorded = []
        for t in range(STEPS):
            recorded += [chosen[t][w, n].item()] * (recorded_key is None or ready[t][w][n])
            assert found[2 * t + 1, w, n].equal(torch.tensor(last_actions(recorded, steps, default)) / 6)
            recorded = [] if done[t][w][0] else recorded
            assert found[2 * t + 2, w, n].equal(torch.tensor(last_actions(recorded, steps, default)) / 6)


@pytest.mark.parametrize("recorded_key", [None, "ready"])
def test_with_an_age_key_the_history_contains_only_actions_chosen_since_the_observation(law, recorded_key):
    default, chosen = 2, choices()
    late = ObservationDelay(law, [OBSERVATION])
    history = ActionHistory(3, ACTION, default=default, recorded_key=recorded_key, age_key="age")
    outputs = play(delayed(late, history), chosen)
    found = torch.stack([td["agents", "action_history"] for td in outputs])
    ages = column(outputs, "agents", "age")
    ready, done = before(outputs, "agents", "ready"), after(outputs, "done")
    for w, n in ROWS:
        recorded: list[tuple[int, int]] = []
        for t in range(STEPS):
            recorded += [(t, chosen[t][w, n].item())] * (recorded_key is None or ready[t][w][n])
            latest = last_actions(recorded, 3, (-STEPS, default))
            since = t + 1 - ages[2 * t + 1][w][n][0]  # when the observation was generated
            expected = [action if at >= since else default for at, action in latest]
            assert found[2 * t + 1, w, n].equal(torch.tensor(expected) / 6)
            recorded = [] if done[t][w][0] else recorded


def test_the_history_contains_the_chosen_actions_not_the_executed_ones():
    delay, history = ActionDelay(3, ACTION), ActionHistory(1, ACTION)
    outputs = play(delayed(delay, history, ends=0.0), choices())
    for output, chosen in zip(outputs[1::2], choices(), strict=True):
        assert output["agents", "action_history"].equal(chosen.unsqueeze(-1) / 6)


def test_a_history_of_action_codes_is_appended_to_the_observation():
    codes = torch.arange(14.0).view(7, 2)
    coded = delayed(ActionHistory(2, ACTION, codes=codes, append_to=OBSERVATION), ends=0.0)
    outputs, undelayed = play(coded, choices()), play(Counting(WORLDS, N_AGENTS, ends=0.0), choices())
    for t in range(2, STEPS):
        observation = outputs[2 * t - 1][OBSERVATION]
        assert observation[..., :7].equal(undelayed[2 * t - 1][OBSERVATION])
        assert observation[..., 7:].equal(
            torch.cat([codes[choices()[t - 2]], codes[choices()[t - 1]]], -1).double()
        )


# Properties that the transforms have on every kind of environment.


class Kind(NamedTuple):
    """An environment, and the keys of its entries."""

    make: Callable[[], EnvBase]
    observation: Any = OBSERVATION
    action: Any = ACTION
    reward: Any = REWARD
    steps: int = 30
    """Number of steps in which an episode ends."""


def vmas(**options: Any) -> EnvBase:
    """A multi-agent environment of VMAS."""
    pytest.importorskip("vmas")
    from torchrl.envs.libs.vmas import VmasEnv  # noqa: PLC0415

    return VmasEnv("balance", num_envs=2, seed=0, max_steps=8, n_agents=2, **options)


def two(name: str, **options: Any) -> EnvBase:
    """Two Gymnasium environments side by side, whose episodes end at different steps."""
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


def rollout_of(env: EnvBase, steps: int) -> list[TensorDictBase]:
    """Outputs of every step and every reset under random actions, which are the same at each call."""
    torch.manual_seed(0)
    env.set_seed(0)
    td, outputs = env.reset(), []
    for _ in range(steps):
        stepped, td = env.step_and_maybe_reset(env.rand_action(td))
        outputs += [stepped.clone(), td.clone()]
    return outputs


@cache
def undelayed_rollout_of(kind: str) -> list[TensorDictBase]:
    """The rollout of an environment without transforms."""
    return rollout_of(KINDS[kind].make(), KINDS[kind].steps)


TRANSFORMS: dict[str, Callable[[Kind, Any], StatefulTransform]] = {
    "observation": lambda kind, law: ObservationDelay(law, [kind.observation], seed=1),
    "observation by arrival": lambda kind, law: ObservationDelay(
        law, [kind.observation], order="arrival", seed=1, fresh_key="fresh", delay_key="delay"
    ),
    "action": lambda kind, law: ActionDelay(law, kind.action, seed=1),
    "reward": lambda kind, law: RewardDelay(law, kind.reward, seed=1),
}
ZERO_DELAYS = {
    "steps": lambda _: 0,
    "a time": lambda _: "0s",
    "uniform": lambda _: Uniform(0, 0, 0.5),
    "never": lambda _: Uniform("3s", "7s", 0.0),
    "geometric": lambda _: Geometric(0, 3),
    "burst": lambda _: Burst(good=0, bad=0, bad_loss=0.0),
    "trace": lambda folder: trace(folder, 0, 0, 0),
}


def check_unchanged(outputs: list[TensorDictBase], undelayed: list[TensorDictBase]) -> None:
    """Check that the outputs contain those without delay, bit for bit and with the same dtypes."""
    for one, other in zip(outputs, undelayed, strict=True):
        assert same(one.select(*other.keys(True, True)), other)
        assert all(one[key].dtype == value.dtype for key, value in other.items(True, True))


ZERO_DELAY_CASES = [
    (kind, law) for kind in KINDS for law in ZERO_DELAYS if kind == "counting" or law in ("steps", "burst")
]
"""Every law on one environment, and two laws on the others."""


@pytest.mark.parametrize(("kind", "zero_delay"), ZERO_DELAY_CASES)
@pytest.mark.parametrize("transform", TRANSFORMS)
def test_with_delay_0_nothing_changes(kind, transform, zero_delay, tmp_path):
    case = KINDS[kind]
    delay = TRANSFORMS[transform](case, ZERO_DELAYS[zero_delay](tmp_path))
    check_unchanged(rollout_of(TransformedEnv(case.make(), delay), case.steps), undelayed_rollout_of(kind))


@kinds
def test_a_clock_of_period_1_a_sum_of_one_reward_and_a_history_change_nothing(kind):
    case = KINDS[kind]
    for transform in (
        SampleAndHold(1, [case.observation], [case.action]),
        CumulativeReward(1, 0.5, case.reward),
        ActionHistory(2, case.action),
    ):
        check_unchanged(
            rollout_of(TransformedEnv(case.make(), transform), case.steps), undelayed_rollout_of(kind)
        )


@kinds
@pytest.mark.parametrize("law", [3, Burst(good=PAPER, bad_loss=0.0)], ids=["constant", "burst"])
def test_the_outputs_of_delayed_environments_match_the_specs(kind, law):
    for make in TRANSFORMS.values():
        env = TransformedEnv(KINDS[kind].make(), make(KINDS[kind], law))
        check_env_specs(env, seed=0, break_when_any_done="both")


@kinds
def test_the_outputs_with_clocks_sums_and_histories_match_the_specs(kind):
    case = KINDS[kind]
    for transform in (
        SampleAndHold(3, [case.observation], [case.action]),
        CumulativeReward(4, 0.9, case.reward),
        ActionHistory(2, case.action),
        ActionHistory(2, case.action, append_to=case.observation),
    ):
        check_env_specs(TransformedEnv(case.make(), transform), seed=0, break_when_any_done="both")


@kinds
def test_the_outputs_with_all_transforms_together_match_the_specs(kind):
    case = KINDS[kind]
    chain = [
        ActionDelay(2, case.action),
        ObservationDelay(PAPER, [case.observation], loss=0.1, fresh_key="fresh", delay_key="delay"),
        RewardDelay(1, case.reward),
        CumulativeReward(3, 0.9, case.reward),
        SampleAndHold(2, [case.observation]),
        ActionHistory(2, case.action, append_to=case.observation),
    ]
    check_env_specs(TransformedEnv(case.make(), Compose(*chain)), seed=0, break_when_any_done="both")


# Causality: no value has an effect before it arrives.


def differs(outputs: Sequence[TensorDictBase], others: Sequence[TensorDictBase], *key: str) -> Tensor:
    """Steps and agents at which an entry differs, [T, B, N] bool."""
    pairs = zip(outputs[1::2], others[1::2], strict=True)
    return torch.stack([(a[key] != b[key]).flatten(2).any(-1) for a, b in pairs])


def only_steps(first: int, last: int, w: int, n: int, total: int) -> Tensor:
    """A mask that is true only for the steps first <= t <= last of one agent, [T, B, N] bool."""
    mask = torch.zeros(total, len(WORLDS), N_AGENTS, dtype=torch.bool)
    mask[first - 1 : last, w, n] = True
    return mask


@pytest.mark.parametrize("order", ["generation", "arrival"])
@pytest.mark.parametrize("name", ["constant", "uniform", "geometric", "trace"])
def test_a_message_has_no_effect_before_it_arrives(name, order, tmp_path):
    n_steps, arrived = 25, 0

    def rollout(tampered: tuple[int, int, int] | None) -> list[TensorDictBase]:
        law = LAWS[name](tmp_path)
        delay = ObservationDelay(law, [OBSERVATION], order=order, delay_key="delay")
        return play(delayed(delay, ends=0.0, tampered=tampered), choices(n_steps=n_steps))

    honest = rollout(None)
    for w, n, sent in ((0, 0, 3), (1, 1, 7), (3, 0, 12)):
        changed = differs(honest, rollout((w, n, sent)), *OBSERVATION)
        arrival = sent + int(honest[2 * sent - 1]["agents", "delay"][w, n])
        assert not changed[: arrival - 1].any()
        changed[:, w, n] = False
        assert not changed.any()
        arrived += differs(honest, rollout((w, n, sent)), *OBSERVATION)[arrival - 1, w, n].item()
    assert arrived > 0


def test_a_message_is_held_from_its_arrival_until_the_next_one():
    def rollout(tampered: tuple[int, int, int] | None) -> list[TensorDictBase]:
        delay = ObservationDelay(4, [OBSERVATION])
        return play(delayed(delay, ends=0.0, tampered=tampered), choices(n_steps=20))

    assert differs(rollout(None), rollout((2, 1, 6)), *OBSERVATION).equal(only_steps(10, 10, 2, 1, 20))


def test_an_action_has_no_effect_before_it_is_executed():
    others = choices(n_steps=20)
    others[6][2, 1] += 1  # chosen before the 7th step
    rollouts = [
        play(delayed(ActionDelay(4, ACTION), ends=0.0), actions) for actions in (choices(n_steps=20), others)
    ]
    assert differs(*rollouts, *OBSERVATION).equal(only_steps(11, 20, 2, 1, 20))


def test_a_reward_has_no_effect_before_it_is_received():
    def rollout(tampered: tuple[int, int, int] | None) -> list[TensorDictBase]:
        return play(delayed(RewardDelay(4, REWARD), ends=0.0, tampered=tampered), choices(n_steps=20))

    assert differs(rollout(None), rollout((2, 1, 6)), *REWARD).equal(only_steps(10, 10, 2, 1, 20))


# Independence of the worlds.


def one_of_each() -> list[StatefulTransform]:
    """One transform of each class, with random delays."""
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


def test_a_worlds_outputs_do_not_depend_on_the_other_worlds():
    together = play(delayed(*one_of_each()), choices())
    assert sum(td["done"].sum().item() for td in together) > 10
    for w, world in enumerate(WORLDS):
        alone = play(delayed(*one_of_each(), worlds=[world]), choices([world]))
        assert all_same([td[w : w + 1] for td in together], alone)


def test_a_reset_of_some_worlds_does_not_change_the_others():
    def rollout(mask: Sequence[bool]) -> list[TensorDictBase]:
        env, outputs = delayed(*one_of_each(), ends=0.0), []
        td = env.reset()
        for t, action in enumerate(choices(n_steps=30)):
            stepped, td = env.step_and_maybe_reset(td.set(ACTION, action))
            outputs.append(stepped["next"].clone())
            if t in (4, 6, 15):
                td = env.reset(td.exclude(ACTION).set("_reset", torch.tensor(mask).unsqueeze(-1)))
                outputs.append(td.exclude("_reset").clone())
        return outputs

    some = rollout([True, False, False, True])
    every = rollout([True, True, True, True])
    none = rollout([False, False, False, False])
    for worlds, expected in (((1, 2), none), ((0, 3), every)):
        for w in worlds:
            assert all_same([td[w] for td in some], [td[w] for td in expected])
    assert not all_same([td[0] for td in some], [td[0] for td in none])


# Delays of actions and of observations together.


@pytest.mark.parametrize("i", range(4))
@pytest.mark.parametrize("j", range(4))
def test_delays_of_observations_and_actions_add_up(i, j):
    """Delays i and j have the same effect as an observation delay i + j (Katsikopoulos, Engelbrecht 2003).

    With both delays, the agent makes the same decisions, but j steps earlier.
    """

    def decide(td: TensorDictBase) -> Tensor:
        return ((td[OBSERVATION] * torch.arange(1.0, 8)).sum(-1) % 7).long()

    def run(env: EnvBase, default_steps: int) -> tuple[Tensor, Tensor, Tensor]:
        td, observed, executed, rewards = env.reset(), [], [], []
        for t in range(20):
            action = torch.zeros(len(WORLDS), N_AGENTS, dtype=torch.long) if t < default_steps else decide(td)
            observed.append(td[OBSERVATION])
            stepped, td = env.step_and_maybe_reset(td.set(ACTION, action))
            executed.append(env.base_env.executed)
            rewards.append(stepped["next", *REWARD])
        return torch.stack(observed), torch.stack(executed), torch.stack(rewards)

    both = run(delayed(ActionDelay(j, ACTION), ObservationDelay(i, [OBSERVATION]), ends=0.0), 0)
    summed = run(delayed(ObservationDelay(i + j, [OBSERVATION]), ends=0.0), j)
    assert both[0][: 20 - j].equal(summed[0][j:])
    assert both[1].equal(summed[1])
    assert both[2].equal(summed[2])
    assert len(both[1].unique()) > 3


# Every kind of action spec.

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


class ActionRecorder(Transform):
    """Gives an environment another action spec, records the actions, and passes zeros on."""

    def __init__(self, spec: TensorSpec) -> None:
        super().__init__(in_keys_inv=[ACTION])
        self.spec, self.recorded = spec, []

    def _inv_call(self, td: TensorDictBase) -> TensorDictBase:
        self.recorded.append(td[ACTION].clone())
        return td.set(ACTION, torch.zeros(GROUP, dtype=torch.long))

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        input_spec["full_action_spec"][ACTION] = self.spec
        return input_spec


@pytest.mark.parametrize("spec", ACTIONS.values(), ids=ACTIONS)
def test_actions_of_every_spec_can_be_delayed_and_recorded(spec):
    recorder = ActionRecorder(spec)
    transforms = Compose(recorder, ActionDelay(2, ACTION), ActionHistory(2, ACTION))
    env = TransformedEnv(Counting(WORLDS, ends=0.0), transforms)
    td, chosen = env.reset(), []
    for _ in range(6):
        td = env.rand_action(td)
        chosen.append(td[ACTION].clone())
        td = env.step_mdp(env.step(td))
    executed = recorder.recorded
    assert spec.is_in(executed[0])
    assert executed[0].equal(executed[1])
    assert all(late.equal(early) for late, early in zip(executed[2:], chosen, strict=False))
    history = td["agents", "action_history"]
    assert history.shape[-1] == 2 * (chosen[0].numel() // len(WORLDS) // N_AGENTS)
    if not isinstance(spec, Unbounded):
        assert ((history >= 0) & (history <= 1)).all()
    assert history.dtype == torch.float32
