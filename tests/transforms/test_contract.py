"""What every transform of damian does in every environment, vector, copy, checkpoint, graph and
collector."""

import copy
import inspect
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import pytest
import torch
from environments import (
    ACTION,
    KINDS,
    LATE,
    OBSERVATION,
    REWARD,
    Drift,
    cartpole,
    uavs,
    unserved,
)
from helpers import all_same, same, saved_and_loaded, square, walking
from streams import check_independent
from torchrl.collectors import Collector
from torchrl.envs import Compose, EnvBase, GymEnv, ParallelEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import RandomPolicy, check_env_specs

import damian.transforms
from damian import Burst, ContextSampler, Law, UavEnv, Uniform
from damian.envs.nodes import Belief, ServerNode
from damian.server.config import ObservationConfig
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    Channel,
    CumulativeReward,
    ObservationDelay,
    ObservationTimeline,
    RewardDelay,
    SampleAndHold,
    StatefulTransform,
    set_seed,
)


class Case(NamedTuple):
    """An environment, and a transform that works on it."""

    env: Callable[[], EnvBase]
    make: Callable[[], Transform]

    def build(self):
        """The environment with the transform."""
        return TransformedEnv(self.env(), self.make())


def _belief():
    observation = ObservationConfig(belief=["belief_moments"])
    scenario = square(observation=observation, source=walking())
    server = UavEnv(scenario, num_worlds=2, extras=["message"], messages_only=True).server
    return Belief(server, longest=0, delayed=False, own=True)


CASES = {
    "Belief": Case(uavs, _belief),
    "ActionDelay, worlds": Case(Drift, lambda: ActionDelay(LATE, loss=0.2)),
    "ActionDelay, agents": Case(uavs, lambda: ActionDelay(LATE, ACTION, sent_key="ready")),
    "ActionHistory, one world": Case(cartpole, lambda: ActionHistory(2, append_to="observation")),
    "ActionHistory, agents": Case(
        uavs, lambda: ActionHistory(2, ACTION, append_to=OBSERVATION, recorded_key="ready")
    ),
    "SampleAndHold, worlds": Case(Drift, lambda: SampleAndHold(2, in_keys_inv=["action"])),
    "SampleAndHold, agents": Case(
        uavs, lambda: SampleAndHold("2s", [OBSERVATION], [ACTION], ready_key=("agents", "ready"))
    ),
    "CumulativeReward, agents": Case(uavs, lambda: CumulativeReward(3, 0.5, REWARD)),
    "ObservationTimeline, one world": Case(cartpole, lambda: ObservationTimeline(3)),
    "ObservationTimeline, agents": Case(
        uavs,
        lambda: ObservationTimeline(
            3, ("agents", "message"), sent_key="message_sent", group=True, own=True
        ),
    ),
    "ObservationDelay, worlds": Case(Drift, lambda: ObservationDelay({"law": "burst"})),
    "ObservationDelay, agents": Case(
        uavs,
        lambda: ObservationDelay(
            LATE, [OBSERVATION], loss=0.2, delay_key="delay", sent_key="message_sent"
        ),
    ),
    "RewardDelay, one world": Case(cartpole, lambda: RewardDelay(LATE)),
    "RewardDelay, agents": Case(uavs, lambda: RewardDelay(LATE, REWARD)),
    "Channel, links": Case(
        uavs,
        lambda: Channel(
            [[0, LATE, 1], [3, 0, 0], [0, LATE, 0]], OBSERVATION, loss=0.2, sent_key="message_sent"
        ),
    ),
    "ServerNode": Case(unserved, lambda: ServerNode(unserved().server, ("agents", "message"))),
}
"""Every transform on every kind of environment that it works on; the name before the comma is its
class."""


def onward(env, td, n_steps=6, seed=0):
    """Step with random actions and partial resets; the outputs of every step and every reset."""
    torch.manual_seed(seed)
    outputs = []
    for _ in range(n_steps):
        after, td = env.step_and_maybe_reset(env.rand_action(td))
        outputs += [after["next"].clone(), td.clone()]
    return outputs


def begun(env, n_steps=5, seed=0):
    """Reset and step an environment; the TensorDict from which ``onward`` can continue."""
    set_seed(env, seed)
    torch.manual_seed(seed)
    td = env.reset()
    return onward(env, td, n_steps, seed)[-1] if n_steps else td


def memory(transform):
    """All tensors that a transform remembers."""
    return [value for value in transform.state_dict().values() if value is not None]


# Every transform on every kind of environment.

GROUPS = {name: kind for name, kind in KINDS.items() if isinstance(kind.observation, tuple)}
"""Kinds whose observations are those of a group of agents, for ``Channel``."""


def observation_delay(kind, law, **options):
    return ObservationDelay(law, kind.observation, delay_key="delay", **options)


TRANSFORMS = {
    "ObservationDelay": observation_delay,
    "ActionDelay": lambda kind, law, **options: ActionDelay(law, kind.action, **options),
    "RewardDelay": lambda kind, law, **options: RewardDelay(
        law, kind.reward, delay_key="reward_delay", earned_key="earned_reward", **options
    ),
    "CumulativeReward": lambda kind, law, **options: CumulativeReward(
        3, 0.5, kind.reward, **options
    ),
    "ActionHistory": lambda kind, law, **options: ActionHistory(3, kind.action, **options),
    "SampleAndHold": lambda kind, law, **options: SampleAndHold(2, kind.observation, **options),
}
every_kind = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


PAIRS = {
    f"{name} on {kind}": (KINDS[kind], make) for kind in KINDS for name, make in TRANSFORMS.items()
} | {
    f"Channel on {name}": (kind, lambda kind, law: Channel(law, kind.observation, loss=0.1))
    for name, kind in GROUPS.items()
}
"""Every kind of environment with every transform, and with a channel where that works."""


every_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
OTHERS = {name: Case(kind.make, partial(make, kind, LATE)) for name, (kind, make) in PAIRS.items()}
everywhere = pytest.mark.parametrize(
    "case", [*CASES.values(), *OTHERS.values()], ids=[*CASES, *OTHERS]
)
AGENTS = {name: case for name, case in CASES.items() if case.env in (uavs, unserved)}
BATCHED = {name: case for name, case in CASES.items() if case.env is not cartpole}


def test_the_cases_cover_every_exported_transform():
    exported = vars(damian.transforms) | {"Belief": Belief, "ServerNode": ServerNode}
    concrete = {
        name
        for name, value in exported.items()
        if inspect.isclass(value)
        and issubclass(value, Transform)
        and value is not StatefulTransform
    }
    assert concrete == {name.split(",")[0] for name in CASES}
    assert all(type(case.make()).__name__ == name.split(",")[0] for name, case in CASES.items())


# Places in which a transform works.


@pytest.mark.sample(4)
@everywhere
def test_the_outputs_match_the_specs_and_every_spec_can_do_without_the_batch(case):
    env = case.build()
    check_env_specs(env, break_when_any_done="both")
    assert env.rollout(12, break_when_any_done=False).shape == (*env.batch_size, 12)
    dims = len(env.batch_size)
    for name in (
        name for name in dir(type(env)) if name.endswith("_spec_unbatched") and name[0] != "_"
    ):
        spec = getattr(env, name)
        whole = getattr(env, name.removesuffix("_unbatched"))
        assert spec.shape == whole.shape[dims:], name
        assert spec.rand().shape == spec.shape


@pytest.mark.sample(4)
@every_case
def test_a_transform_works_around_a_vector_of_environments(case):
    env = TransformedEnv(SerialEnv(2, case.env), case.make())
    check_env_specs(env, break_when_any_done="both")
    assert env.rollout(12, break_when_any_done=False).shape == (2, *case.env().batch_size, 12)


def some(cases, fast):
    """The cases as a parameter; all but the ``fast`` ones are slow tests, because they take
    seconds."""
    slow = pytest.mark.slow
    values = [
        pytest.param(
            case,
            id=n,
            marks=() if n in fast else slow,
        )
        for n, case in cases.items()
    ]
    return pytest.mark.parametrize("case", values)


@some(AGENTS, fast=["ServerNode"])
def test_a_transform_works_in_worker_processes(case):
    env = ParallelEnv(2, case.build, mp_start_method="fork")
    try:
        check_env_specs(env, break_when_any_done="both")
        assert env.rollout(8, break_when_any_done=False).shape == (2, 2, 8)
    finally:
        env.close()


# Copies.


COPIES = {"pickle": lambda env: pickle.loads(pickle.dumps(env)), "deepcopy": copy.deepcopy}


@pytest.mark.sample(8)
@every_case
@pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)
@pytest.mark.parametrize("n_steps", [0, 5])
def test_a_copy_made_during_an_episode_continues_like_the_original(case, copied, n_steps):
    env = case.build()
    td = begun(env, n_steps)
    twin = copied(env)
    outputs = onward(twin, td.clone())
    assert all_same(onward(env, td.clone()), outputs)


# Checkpoints.


@pytest.mark.sample(10)
@every_case
@pytest.mark.parametrize(
    ("n_steps", "used"),
    [
        (5, True),
        (5, False),
        (0, True),
    ],
)
@pytest.mark.parametrize("whole", [True, False])
def test_a_loaded_checkpoint_continues_bit_for_bit(case, whole, n_steps, used):
    env = case.build()
    td = begun(env, n_steps)
    transform = case.make()
    if used:
        begun(TransformedEnv(case.env(), transform), 3, seed=9)
        transform.reset_parent()
    twin = TransformedEnv(copy.deepcopy(env.base_env), transform)
    saved, into = (env, twin) if whole else (env.transform, twin.transform)
    into.load_state_dict(saved_and_loaded(saved.state_dict()))
    assert all_same(onward(env, td.clone()), onward(twin, td.clone()))


@pytest.mark.sample(4)
@every_case
def test_a_state_that_is_loaded_after_a_reset_shows_no_message_of_its_own_episode(case):
    """Only random streams are loaded, so that it is all one whether the state or the reset comes
    first."""
    other = case.build()
    made = []
    begun(other)
    state = saved_and_loaded(other.transform.state_dict())
    for state_first in (True, False):
        env = case.build()
        set_seed(env, 0)
        torch.manual_seed(0)
        if state_first:
            env.load_state_dict(state)
        td = env.reset()
        if not state_first:
            env.load_state_dict(state)
        made.append(onward(env, td))
    assert all_same(*made)


@pytest.mark.sample(4)
@every_case
def test_in_the_middle_of_an_episode_no_other_state_is_loaded(case):
    env = case.build()
    twin = case.build()
    other = case.build()
    td = begun(env, 3)
    _ = begun(twin, 3)
    _ = begun(other, 5, seed=9)
    with pytest.warns(UserWarning, match="in the middle of an episode no state is loaded"):
        env.load_state_dict(saved_and_loaded(other.state_dict()))
    assert all_same(onward(env, td.clone()), onward(twin, td.clone()))


# Graphs.


@pytest.mark.slow
@every_case
def test_a_step_compiles_into_one_graph_that_does_the_same(case):
    env = case.build()
    twin = case.build()
    td = begun(env)
    _ = begun(twin)
    torch._dynamo.reset()
    compiled = torch.compile(whole_step(twin.transform), fullgraph=True, backend="eager")
    for _ in range(4):
        td = env.rand_action(td)
        after = env.base_env.step(td)["next"]
        one = whole_step(env.transform)(td, after.clone())
        other = compiled(td, after.clone())
        assert same(one, other)
    assert all(
        a.equal(b) for a, b in zip(memory(env.transform), memory(twin.transform), strict=True)
    )


def whole_step(transform):
    """A function that passes the inputs and then the outputs of a step through a transform."""

    def step(td, after):
        return transform._step(transform.inv(td), after)

    return step


# Collectors.


@pytest.mark.sample(5)
@every_case
def test_a_collector_returns_the_same_data_as_a_rollout(case):
    env = case.build()
    twin = case.build()
    for each in (env, twin):
        set_seed(each, 0)
    n_worlds = env.batch_size.numel()
    torch.manual_seed(5)
    policy = RandomPolicy(env.full_action_spec)
    collector = Collector(env, policy, frames_per_batch=6 * n_worlds, total_frames=12 * n_worlds)
    torch.manual_seed(5)
    batches = [batch.clone() for batch in collector]
    torch.manual_seed(5)
    rollout = twin.rollout(12, policy, break_when_any_done=False)
    collected = torch.cat(batches, -1).select(*rollout.keys(True, True))
    assert rollout["next", "done"].any()
    assert same(collected, rollout)


@pytest.mark.parametrize("case", BATCHED.values(), ids=BATCHED)
def test_a_reset_of_some_worlds_does_not_change_the_others(case):
    env = case.build()
    twin = case.build()
    td = begun(env, 2)
    _ = begun(twin, 2)
    mask = torch.zeros(*env.batch_size, 1, dtype=torch.bool)
    mask[0] = True
    reset = env.reset(td.clone().set("_reset", mask))
    assert same(reset[1:], td[1:].select(*reset.keys(True, True)))
    torch.manual_seed(0)
    actions = twin.rand_action(td.clone()).select(*env.action_keys)
    outputs = [
        each.step(state.clone().update(actions))["next"]
        for each, state in ((env, reset), (twin, td))
    ]
    assert same(outputs[0][1:], outputs[1][1:])


# Memory.


@pytest.mark.sample(6)
@everywhere
def test_what_is_written_shares_no_memory_with_the_buffers(case):
    env = case.build()
    set_seed(env, 0)
    td = env.reset()
    for _ in range(5):
        owned = memory(env.transform)
        td = env.rand_action(td)
        executed = env.transform.inv(td.clone())
        owned += memory(env.transform)
        after, td = env.step_and_maybe_reset(td)
        owned += memory(env.transform)
        shown = [*executed.values(True, True), *after.values(True, True), *td.values(True, True)]
        assert not storages(owned) & storages(shown)


def storages(tensors):
    """Addresses of the memory of tensors."""
    return {tensor.untyped_storage().data_ptr() for tensor in tensors if tensor.numel()}


# Without delay nothing changes.


IDENTITIES = {
    "ObservationDelay": lambda kind: observation_delay(kind, 0),
    "ObservationDelay, bursts": lambda kind: observation_delay(
        kind, Burst(good=0, bad=0, bad_loss=0.0)
    ),
    "ActionDelay": lambda kind: ActionDelay(Uniform(0, 0, 0.5), kind.action),
    "RewardDelay": lambda kind: RewardDelay("0s", kind.reward),
    "CumulativeReward": lambda kind: CumulativeReward(1, 0.5, kind.reward),
    "ActionHistory": lambda kind: ActionHistory(3, kind.action),
    "SampleAndHold": lambda kind: (
        SampleAndHold(1, kind.observation, kind.action)
        if kind.observation != "state"
        else SampleAndHold(1, kind.observation)
    ),
}


@pytest.mark.sample(7)
@every_kind
@pytest.mark.parametrize("identity", IDENTITIES.values(), ids=IDENTITIES)
def test_delay_0_changes_nothing_for_a_policy_that_draws_from_torchs_generator(kind, identity):
    envs = (kind.make(), TransformedEnv(kind.make(), identity(kind)))
    undelayed, delayed = (onward(env, begun(env, 0), 8) for env in envs)
    pairs = zip(delayed, undelayed, strict=True)
    assert all_same([td.select(*other.keys(True, True)) for td, other in pairs], undelayed)


# Seeds.


@pytest.mark.parametrize("wrap", [False, True])
def test_all_streams_of_an_environment_differ(wrap):
    def chain():
        return [
            ActionDelay(LATE, ("agents", "action"), seed=0),
            ObservationDelay(LATE, ("agents", "observation"), seed=0),
            ObservationDelay(LATE, "state", seed=0),
            RewardDelay(LATE, ("agents", "reward"), seed=0),
            RewardDelay(LATE, "team_reward", seed=0),
            ObservationDelay(LATE, ("agents", "observation"), age_key=None, seed=0),
        ]

    for seeded in (False, True):
        env = KINDS["flags in the group"].make()
        transforms = chain()
        for transform in transforms if wrap else [Compose(*transforms)]:
            env = TransformedEnv(env, transform, auto_unwrap=False)
        if seeded:
            set_seed(env, 7919)
        env.reset()
        streams = torch.cat([transform.memory["streams"] for transform in transforms])
        assert len(streams.unique()) == len(streams) == 4 * 4 + 2 * 2
        check_independent(streams)


def pendulum(seed):
    delays = Compose(ObservationDelay(LATE, seed=seed), RewardDelay(LATE, seed=seed))
    return TransformedEnv(GymEnv("Pendulum-v1"), delays)


def worker_streams(env):
    """The streams of all transforms of all workers, read from the state of a reset environment."""
    found = []

    def walk(state):
        for key, value in state.items():
            if isinstance(value, dict):
                walk(value)
            elif key.endswith("streams"):
                found.extend(value.flatten().tolist())

    env.reset()
    walk(env.state_dict())
    return found


@pytest.mark.parametrize("vector", [SerialEnv, pytest.param(ParallelEnv, marks=pytest.mark.slow)])
def test_workers_have_streams_of_their_own_that_follow_from_their_seeds(vector):
    options = {"mp_start_method": "fork"} if vector is ParallelEnv else {}
    found = []
    for seeds in ((None, None, None), (0, 1, 2), (3, 4, 5), (0, 1, 2)):
        env = vector(3, [partial(pendulum, seed) for seed in seeds], **options)
        found.append(worker_streams(env))
        env.close()
    assert len({*found[0], *found[1], *found[2]}) == 18
    check_independent(torch.tensor([*found[0], *found[1], *found[2]]))
    assert found[1] == found[3]


# Worlds that skip a step.


def two_worlds():
    """Two CartPoles, of which some may skip a step."""
    return SerialEnv(2, lambda: GymEnv("CartPole-v1", categorical_action_encoding=True))


@dataclass(frozen=True)
class ByContent(Law):
    """Delays that follow from the message, so that what a skipped step would send arrives at
    another time."""

    def sampler(self, dt=1.0, loss=0.0, key="delay"):
        return ContextSampler(
            lambda c: (c.entries["seen"][:, 1] * 100).abs().floor() % 4, 3, reads=["seen"]
        )


@pytest.mark.parametrize(
    "make",
    [
        *TRANSFORMS.values(),
        lambda kind, _: ObservationDelay(ByContent(), context_keys={"seen": "observation"}),
    ],
    ids=[*TRANSFORMS, "ObservationDelay by content"],
)
def test_a_world_that_skips_steps_goes_on_as_if_they_had_not_been(make):
    kind = KINDS["CartPole"]
    law = Burst(
        0.4,
        0.4,
        good=Uniform(0, 2),
        bad=3,
        bad_loss=0.0,
    )
    skipping, steady = (TransformedEnv(two_worlds(), make(kind, law)) for _ in range(2))
    for env in (skipping, steady):
        set_seed(env, 1)
        env.transform.seed_worlds(torch.tensor([5, 6]))
    td = skipping.reset()
    other = steady.reset()
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
            rest = skipping.step(
                td.clone().set("action", actions[t]).set("_step", torch.zeros(2).bool())
            )
            assert rest["next", "observation"].equal(td["observation"])
        other = other.clone().update(after.select(*other.keys(True, True), strict=False))
