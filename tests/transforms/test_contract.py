"""What TorchRL's own transforms do, every transform does on every kind of environment."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from contract import Drift
from environments import KINDS, Kind, vmas
from helpers import all_same, same
from streams import check_independent
from tensordict import TensorDictBase
from torchrl.envs import Compose, EnvBase, GymEnv, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from damian.delays.laws import Burst, Uniform
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    Channel,
    CumulativeReward,
    ObservationDelay,
    RewardDelay,
    SampleAndHold,
    StatefulTransform,
)

LATE = Uniform(1, 3)
GROUPS = {name: kind for name, kind in KINDS.items() if isinstance(kind.observation, tuple)}
"""Kinds whose observations are those of a group of agents, for ``Channel``."""


def observation_delay(kind: Kind, law: Any, **options: Any) -> StatefulTransform:
    """An observation delay; where the environment reads its state from the observation, under another key."""
    out_keys = ["seen"] if kind.stateless else None
    flags = {"fresh_key": "fresh", "delay_key": "delay"}
    return ObservationDelay(law, kind.observation, out_keys, **flags, **options)


TRANSFORMS: dict[str, Callable[..., StatefulTransform]] = {
    "ObservationDelay": observation_delay,
    "ActionDelay": lambda kind, law, **options: ActionDelay(law, kind.action, **options),
    "RewardDelay": lambda kind, law, **options: RewardDelay(law, kind.reward, **options),
    "CumulativeReward": lambda kind, law, **options: CumulativeReward(3, 0.5, kind.reward, **options),
    "ActionHistory": lambda kind, law, **options: ActionHistory(3, kind.action, **options),
    "SampleAndHold": lambda kind, law, **options: (
        SampleAndHold(2, (), kind.action, **options)
        if kind.stateless
        else SampleAndHold(2, kind.observation, **options)
    ),
}
IDENTITIES: dict[str, Callable[[Kind], StatefulTransform]] = {
    "ObservationDelay": lambda kind: observation_delay(kind, 0),
    "ObservationDelay, bursts": lambda kind: observation_delay(kind, Burst(good=0, bad=0, bad_loss=0.0)),
    "ActionDelay": lambda kind: ActionDelay(Uniform(0, 0, 0.5), kind.action),
    "RewardDelay": lambda kind: RewardDelay("0s", kind.reward),
    "CumulativeReward": lambda kind: CumulativeReward(1, 0.5, kind.reward),
    "ActionHistory": lambda kind: ActionHistory(3, kind.action),
    "SampleAndHold": lambda kind: (
        SampleAndHold(1, () if kind.stateless else kind.observation, kind.action)
        if kind.observation != "state"
        else SampleAndHold(1, kind.observation)
    ),
}

every_kind = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


def channel(kind: Kind, law: Any, **options: Any) -> StatefulTransform:
    """A channel between the agents of a group; it works only where there is one."""
    return Channel(law, kind.observation, loss=0.1, **options)


def cases(transforms: dict[str, Callable[..., StatefulTransform]]) -> pytest.MarkDecorator:
    """Every kind of environment with every one of the transforms, and with a channel where that works."""
    pairs = {
        f"{name}, {kind}": (KINDS[kind], make) for kind in KINDS for name, make in transforms.items()
    } | {f"Channel, {name}": (kind, channel) for name, kind in GROUPS.items()}
    return pytest.mark.parametrize(("kind", "make"), pairs.values(), ids=pairs)


every_case = cases(TRANSFORMS)
FAST = {
    "ObservationDelay, PettingZoo, state",
    "RewardDelay, flags in the group, root entries",
    "ActionDelay, batch chosen at reset",
    "Channel, VMAS",
}
"""Cases that are compiled in every run of the tests; the others take a second each, and are slow tests."""
every_transform = pytest.mark.parametrize("make", TRANSFORMS.values(), ids=TRANSFORMS)
drawing = cases({name: TRANSFORMS[name] for name in ("ObservationDelay", "ActionDelay", "RewardDelay")})


def played(env: EnvBase, kind: Kind, n_steps: int = 8, seed: int | None = 0) -> list[TensorDictBase]:
    """Outputs of every step and every reset, with actions drawn from torch's generator."""
    if seed is not None:
        torch.manual_seed(seed)
        env.set_seed(seed)
    td, outputs = env.reset(kind.begin(env)), []
    for _ in range(n_steps):
        after, td = env.step_and_maybe_reset(env.rand_action(td))
        outputs += [after["next"].clone(), td.clone()]
    return outputs


# Specs.


@every_case
def test_the_outputs_match_the_specs_and_every_spec_can_do_without_the_batch(kind, make):
    env = TransformedEnv(kind.make(), make(kind, LATE))
    if kind.stateless:
        assert set(played(env, kind)[-1].keys(True, True)) >= set(env.full_observation_spec.keys(True, True))
    else:
        check_env_specs(env, break_when_any_done="both")
    dims = len(env.batch_size)
    for name in (name for name in dir(type(env)) if name.endswith("_spec_unbatched") and name[0] != "_"):
        spec, whole = getattr(env, name), getattr(env, name.removesuffix("_unbatched"))
        assert spec.shape == whole.shape[dims:], name
        assert spec.rand().shape == spec.shape


@every_transform
def test_the_outputs_match_the_specs_if_floats_have_64_bits(make):
    torch.set_default_dtype(torch.float64)
    try:
        kind = KINDS["Pendulum"]
        check_env_specs(TransformedEnv(kind.make(), make(kind, LATE)), break_when_any_done="both")
        check_env_specs(TransformedEnv(Drift(), make(kind, LATE)), break_when_any_done="both")
    finally:
        torch.set_default_dtype(torch.float32)


# Identity.


@pytest.mark.parametrize("kind", GROUPS.values(), ids=GROUPS)
def test_a_channel_without_delay_shows_current_messages_and_changes_nothing_else(kind):
    undelayed = played(kind.make(), kind)
    delayed = played(TransformedEnv(kind.make(), Channel(0, kind.observation)), kind)
    group = kind.observation[0]
    for td, other in zip(delayed, undelayed, strict=True):
        assert same(td.select(*other.keys(True, True)), other)
        sent = other[kind.observation]
        assert td[group, "received"].equal(sent.unsqueeze(-3).expand_as(td[group, "received"]))
        assert not td[group, "received_age"].any()
        assert td[group, "received_mask"].all()


@every_kind
@pytest.mark.parametrize("identity", IDENTITIES.values(), ids=IDENTITIES)
def test_delay_0_changes_nothing_for_a_policy_that_draws_from_torchs_generator(kind, identity):
    undelayed = played(kind.make(), kind)
    transform = identity(kind)
    env = TransformedEnv(kind.make(), transform)
    delayed = played(env, kind)
    pairs = zip(delayed, undelayed, strict=True)
    assert all_same([td.select(*other.keys(True, True)) for td, other in pairs], undelayed)


# Seeds.


@drawing
def test_the_seed_of_a_plain_environment_reaches_its_transforms(kind, make):
    env = TransformedEnv(kind.make(), make(kind, Uniform(0, 20)))
    outputs, streams = [], []
    for number, seed in enumerate((3, 4, 3)):
        torch.manual_seed(number)  # the state of torch's generator does not matter
        env.set_seed(seed)
        begin = kind.begin(env)
        outputs.append([env.reset(begin)])
        streams.append(env.transform.memory["streams"].clone())
        torch.manual_seed(0)
        for _ in range(3):
            after, td = env.step_and_maybe_reset(env.rand_action(outputs[-1][-1].clone()))
            outputs[-1] += [after["next"], td]
    assert streams[0].equal(streams[2])
    assert not set(streams[0].tolist()) & set(streams[1].tolist())
    if not kind.stateless and kind.make is not vmas:  # VMAS itself goes on with its earlier random state
        assert all_same(outputs[0], outputs[2])


@pytest.mark.parametrize("wrap", [False, True], ids=["one environment", "nested environments"])
def test_all_streams_of_an_environment_differ(wrap):
    def chain() -> list[StatefulTransform]:
        return [
            ActionDelay(LATE, ("agents", "action"), seed=0),
            ObservationDelay(LATE, ("agents", "observation"), seed=0),
            ObservationDelay(LATE, "state", seed=0),
            RewardDelay(LATE, ("agents", "reward"), seed=0),
            RewardDelay(LATE, "team_reward", seed=0),
            ObservationDelay(LATE, ("agents", "observation"), seed=0),
        ]

    for seeded in (False, True):
        env, transforms = KINDS["flags in the group"].make(), chain()
        for transform in transforms if wrap else [Compose(*transforms)]:
            env = TransformedEnv(env, transform, auto_unwrap=False)
        if seeded:
            env.set_seed(7919)
        env.reset()
        streams = torch.cat([transform.memory["streams"] for transform in transforms])
        assert len(streams.unique()) == len(streams) == 4 * 4 + 2 * 2
        check_independent(streams)


def test_another_transform_does_not_change_the_draws():
    alone = TransformedEnv(GymEnv("Pendulum-v1"), ObservationDelay(LATE))
    beside = TransformedEnv(GymEnv("Pendulum-v1"), Compose(ActionDelay(1), ObservationDelay(LATE)))
    for env in (alone, beside):
        env.set_seed(5)
        env.reset()
    assert alone.transform.memory["streams"].equal(beside.transform[1].memory["streams"])


def pendulum() -> TransformedEnv:
    return TransformedEnv(GymEnv("Pendulum-v1"), Compose(ObservationDelay(LATE), RewardDelay(LATE)))


def worker_streams(env: EnvBase) -> list[int]:
    """The streams of all transforms of all workers, read from the state of a reset environment."""
    found: list[int] = []

    def walk(state: Any) -> None:
        for key, value in state.items():
            if isinstance(value, dict):
                walk(value)
            elif key.endswith("streams"):
                found.extend(value.flatten().tolist())

    env.reset()
    walk(env.state_dict())
    return found


@pytest.mark.parametrize("vector", [SerialEnv, ParallelEnv])
def test_workers_have_streams_of_their_own_that_follow_from_one_seed(vector):
    options = {"mp_start_method": "fork"} if vector is ParallelEnv else {}
    env = vector(3, pendulum, **options)
    try:
        unseeded = worker_streams(env)
        seeded = []
        for seed in (0, 1, 0):
            env.set_seed(seed)
            seeded.append(worker_streams(env))
    finally:
        env.close()
    assert len(set(unseeded)) == len(unseeded) == 6
    assert len({*seeded[0], *seeded[1]}) == 12
    check_independent(torch.tensor([*unseeded, *seeded[0], *seeded[1]]))
    assert seeded[0] == seeded[2]


# Memory.


@every_case
def test_what_is_written_shares_no_memory_with_the_buffers(kind, make):
    env = TransformedEnv(kind.make(), make(kind, LATE))
    env.set_seed(0)
    td = env.reset(kind.begin(env))
    for _ in range(5):
        owned = [*env.transform.memory.values()]
        td = env.rand_action(td)
        executed = env.transform.inv(td.clone())
        owned += env.transform.memory.values()
        after, td = env.step_and_maybe_reset(td)
        owned += env.transform.memory.values()
        shown = [*executed.values(True, True), *after.values(True, True), *td.values(True, True)]
        assert not storages(owned) & storages(shown)


def storages(tensors: list[torch.Tensor]) -> set[int]:
    """Addresses of the memory of tensors."""
    return {tensor.untyped_storage().data_ptr() for tensor in tensors if tensor.numel()}


OTHER_SIZES = {
    "ObservationDelay": (lambda: ObservationDelay(2), lambda: ObservationDelay(5)),
    "ObservationDelay, keys": (
        lambda: ObservationDelay(2),
        lambda: ObservationDelay(2, ["a", "observation"]),
    ),
    "ActionDelay": (lambda: ActionDelay(2), lambda: ActionDelay(5)),
    "RewardDelay": (lambda: RewardDelay(2), lambda: RewardDelay(5)),
    "CumulativeReward": (lambda: CumulativeReward(2), lambda: CumulativeReward(5)),
    "ActionHistory": (lambda: ActionHistory(2), lambda: ActionHistory(5)),
    "SampleAndHold": (lambda: SampleAndHold(2), lambda: SampleAndHold(5)),
}


@pytest.mark.parametrize("pair", OTHER_SIZES.values(), ids=OTHER_SIZES)
@pytest.mark.parametrize("swapped", [False, True])
def test_the_state_of_another_delay_is_refused(pair, swapped):
    one, other = (make() for make in (pair[::-1] if swapped else pair))
    if "a" in one.in_keys:
        one, other = other, one
    env = TransformedEnv(GymEnv("Pendulum-v1"), one)
    env.rollout(3)
    with pytest.raises(RuntimeError, match=rf"{type(one).__name__} has .*loaded state is of one with"):
        other.load_state_dict(one.state_dict())
    assert not other.has_memory


@every_transform
@pytest.mark.parametrize("first", [True, False], ids=["the reset", "a step"])
def test_after_inference_mode_come_normal_steps(make, first):
    env, expected = (TransformedEnv(Drift(), make(KINDS["Pendulum"], LATE)) for _ in range(2))
    outputs = []
    for each, inference in ((env, True), (expected, False)):
        each.set_seed(0)
        torch.manual_seed(0)
        with torch.inference_mode(inference and first):
            td = each.reset()
        with torch.inference_mode(inference and not first):
            td = each.step_and_maybe_reset(each.rand_action(td))[1]
        outputs.append([])
        for _ in range(5):
            td = each.step_and_maybe_reset(each.rand_action(td.clone()))[1]
            outputs[-1].append(td.clone())
    assert all_same(*outputs)


# Graphs.


@pytest.mark.parametrize(
    ("kind", "make"),
    [
        pytest.param(*pair, id=name, marks=() if name in FAST else pytest.mark.slow)
        for name, pair in zip(every_case.kwargs["ids"], every_case.args[1], strict=True)
    ],
)
def test_a_step_compiles_into_one_graph_that_does_the_same(kind, make):
    env, twin = (TransformedEnv(kind.make(), make(kind, LATE)) for _ in range(2))
    for each in (env, twin):
        each.set_seed(0)
        td = each.reset(kind.begin(each))
    torch._dynamo.reset()

    def step(transform, td, after):
        return transform._step(transform.inv(td), after)

    compiled = torch.compile(step, fullgraph=True, backend="eager")
    for _ in range(3):
        td = env.rand_action(td)
        after = env.base_env.step(td.clone())["next"]
        outputs = step(env.transform, td, after.clone()), compiled(twin.transform, td, after.clone())
        assert same(*outputs)


# Worlds that skip a step.


def two_worlds() -> EnvBase:
    """Two CartPoles, of which some may skip a step."""
    return SerialEnv(2, lambda: GymEnv("CartPole-v1", categorical_action_encoding=True))


@every_transform
def test_a_world_that_skips_steps_goes_on_as_if_they_had_not_been(make):
    kind, law = KINDS["CartPole"], Burst(0.4, 0.4, good=Uniform(0, 2), bad=3, bad_loss=0.0)
    skipping, steady = (TransformedEnv(two_worlds(), make(kind, law)) for _ in range(2))
    for env in (skipping, steady):
        env.set_seed(1)
        env.transform.seed_worlds(torch.tensor([5, 6]))
    td, other = skipping.reset(), steady.reset()
    actions = torch.randint(2, (8, 2), generator=torch.Generator().manual_seed(0))
    for t in range(8):
        after = steady.step(other.clone().set("action", actions[t]))["next"]
        for world in (0, 1):  # first the one, then the other; and now and then none
            mask = torch.tensor([world == 0, world == 1])
            # What the other world would have chosen must have no effect.
            chosen = torch.where(mask, actions[t], 1 - actions[t])
            stepped = skipping.step(td.clone().set("action", chosen).set("_step", mask))["next"]
            assert same(stepped[world], after[world])
            td[world] = stepped[world].select(*td.keys(True, True), strict=False)
            rest = skipping.step(td.clone().set("action", actions[t]).set("_step", torch.zeros(2).bool()))
            assert rest["next", "observation"].equal(td["observation"])
        other = other.clone().update(after.select(*other.keys(True, True), strict=False))


# Gradients.


def action_gradients(transform: StatefulTransform | None, key: Any = "observation") -> list[torch.Tensor]:
    """The gradient of each step's entry with respect to the actions of all steps so far."""
    env = Drift() if transform is None else TransformedEnv(Drift(), transform)
    td, actions, gradients = env.reset(), [], []
    for _ in range(3):
        actions.append(torch.full((3, 2), 0.5, requires_grad=True))
        td = env.step(td.clone().set("action", actions[-1]))["next"]
        value = td[key].sum()
        found = (
            torch.autograd.grad(value, actions, retain_graph=True, allow_unused=True)
            if (value.requires_grad)
            else [None] * len(actions)
        )
        gradients.append(torch.stack([torch.zeros(3, 2) if one is None else one for one in found]))
    return gradients


def test_at_delay_0_gradients_are_those_of_the_environment():
    kind = KINDS["Pendulum"]
    undelayed = action_gradients(None)
    assert undelayed[0].any()
    for name in ("ObservationDelay", "ActionDelay", "RewardDelay"):
        found = action_gradients(TRANSFORMS[name](kind, 0, gradients=True))
        assert all(a.equal(b) for a, b in zip(found, undelayed, strict=True))


def test_gradients_reach_back_to_when_the_held_entry_was_made():
    kind = KINDS["Pendulum"]
    undelayed = action_gradients(None)[0][0]
    for name in ("ObservationDelay", "ActionDelay"):
        found = action_gradients(TRANSFORMS[name](kind, 1, gradients=True))
        assert not found[0].any()
        assert found[1][0].equal(undelayed)
        assert found[2][1].equal(undelayed)
    summed = action_gradients(CumulativeReward(2, 0.5, gradients=True), "reward")
    assert summed[1][0].equal(0.5 * summed[1][1])
    held = action_gradients(SampleAndHold(2, "observation", gradients=True))
    assert not held[0].any()
    assert held[1][1].equal(undelayed)
    assert held[2][1].equal(undelayed)


def test_by_default_there_are_no_gradients():
    for name in ("ObservationDelay", "SampleAndHold"):
        assert not any(found.any() for found in action_gradients(TRANSFORMS[name](KINDS["Pendulum"], 1)))


# Flags at any level.


def test_a_root_reward_is_paid_whole_though_only_its_agents_are_done():
    kind = KINDS["flags in the group"]
    env = TransformedEnv(kind.make(), RewardDelay(3, "team_reward"))
    paid = torch.stack([td["team_reward"] for td in played(env, kind, 30)[::2]])
    assert paid[:, 0, 0].tolist() == [0.0, 0.0, 3.0] * 10
    assert paid[:, 1, 0].tolist() == [0.0, 0.0, 0.0, 1.0, 4.0] * 6


def test_a_reset_of_the_agents_of_one_world_resets_the_root_entries_of_that_world_only():
    kind = KINDS["flags in the group, root entries"]
    env = TransformedEnv(kind.make(), ObservationDelay(2, "state"))
    td = env.reset()
    for _ in range(2):
        td = env.step(env.rand_action(td))["next"].exclude("team_reward")
    assert td["age"].flatten().tolist() == [2.0, 2.0]
    mask = torch.tensor([True, False]).view(2, 1, 1).expand(2, 2, 1)
    env.reset(td.clone().set(("agents", "_reset"), mask))
    assert env.transform.memory["reset_at"].tolist() == [2, 0]
    td = env.step(env.rand_action(td))["next"]
    assert td["age"].flatten().tolist() == [1.0, 2.0]
    assert td["state"].flatten().tolist() == [0.0, 1.0]


def test_where_flags_have_several_levels_the_outermost_reset_decides():
    kind = KINDS["PettingZoo"]
    env = TransformedEnv(kind.make(), ObservationDelay(2, kind.observation))
    td = env.reset()
    for _ in range(2):
        td = env.step(env.rand_action(td))["next"]
    flags = {"_reset": torch.tensor([True]), ("agent", "_reset"): torch.tensor([[True], [False]])}
    for key, flag in flags.items():
        td.set(key, flag)
    env.reset(td)
    assert env.transform.memory["reset_at"].tolist() == [2, 2]


# A batch chosen at reset.


@every_transform
def test_a_batch_chosen_at_reset_does_what_its_worlds_do_alone(make):
    kind = KINDS["batch chosen at reset"]
    env, alone = (TransformedEnv(kind.make(), make(kind, LATE)) for _ in range(2))
    torch.manual_seed(0)
    first, actions = env.base_env.gen_params(batch_size=[3]), torch.rand(6, 3, 1) * 4 - 2
    seeds, outputs = torch.tensor([4, 5, 6]), []
    first.update(env.base_env.reset(first.clone()).select("th", "thdot"))
    env.transform.seed_worlds(seeds)
    begun = env.reset(first.clone())
    td = begun.clone()
    for action in actions:
        td = step_mdp(env.step(td.clone().set("action", action)), exclude_reward=False)
        outputs.append(td)
    for world in range(3):
        alone.transform.seed_worlds(seeds[world : world + 1])
        td = alone.reset(first[world : world + 1].clone())
        td.update(begun[world : world + 1].select("th", "thdot"))
        for action, expected in zip(actions, outputs, strict=True):
            chosen = td.clone().set("action", action[world : world + 1])
            td = step_mdp(alone.step(chosen), exclude_reward=False)
            assert same(td, expected[world : world + 1])


@every_transform
def test_another_batch_size_at_a_reset_begins_anew(make):
    kind = KINDS["batch chosen at reset"]
    env = TransformedEnv(kind.make(), make(kind, LATE))
    for n_worlds in (3, 5, 2):
        td = env.reset(env.gen_params(batch_size=[n_worlds]))
        td = env.step(env.rand_action(td))["next"]
        assert td.shape == (n_worlds,)
        assert env.transform.rows.numel() == n_worlds


# Keys.


def test_a_key_may_stand_for_a_list_of_one_key():
    for key in ("observation", ["observation"], ("observation",)):
        assert ObservationDelay(2, key).in_keys == ["observation"]
    for key in (("agents", "observation"), [("agents", "observation")]):
        assert ObservationDelay(2, key).in_keys == [("agents", "observation")]
    assert ObservationDelay(2, ["a", ("b", "c")]).in_keys == ["a", ("b", "c")]


def test_two_names_in_a_tuple_are_one_key_and_the_error_says_so():
    env = TransformedEnv(KINDS["batch chosen at reset"].make(), ObservationDelay(2, ("th", "thdot")))
    with pytest.raises(ValueError, match=r"one nested key.*two keys are written \['th', 'thdot'\]"):
        env.reset(env.gen_params(batch_size=[2]))
