"""Every transform works with vectors of environments, copies, checkpoints, graphs and collectors."""

import copy
import inspect
import io
import pickle
from functools import partial

import pytest
import torch
from contract import (
    CASES,
    Case,
    begun,
    cartpole,
    memory,
    onward,
    uavs,
    unserved,
)
from every_transform import LATE, PAIRS
from helpers import all_same, same
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import RandomPolicy, check_env_specs

import damian.transforms
from damian.transforms import StatefulTransform, set_seed
from damian.transforms.server_node import Belief, ServerNode

every_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
OTHERS = {name: Case(kind.make, partial(make, kind, LATE)) for name, (kind, make) in PAIRS.items()}
everywhere = pytest.mark.parametrize("case", [*CASES.values(), *OTHERS.values()], ids=[*CASES, *OTHERS])
AGENTS = {name: case for name, case in CASES.items() if case.env in (uavs, unserved)}
BATCHED = {name: case for name, case in CASES.items() if case.env is not cartpole}


def test_the_cases_cover_every_exported_transform():
    exported = {name: getattr(damian.transforms, name) for name in damian.transforms.__all__}
    exported |= {"Belief": Belief, "ServerNode": ServerNode}
    concrete = {
        name
        for name, value in exported.items()
        if inspect.isclass(value) and issubclass(value, Transform) and value is not StatefulTransform
    }
    assert concrete == {name.split(",")[0] for name in CASES}
    assert all(type(case.make()).__name__ == name.split(",")[0] for name, case in CASES.items())


# Places in which a transform works.


@pytest.mark.sample(3)
@everywhere
def test_the_outputs_match_the_specs_and_every_spec_can_do_without_the_batch(case):
    env = case.build()
    check_env_specs(env, break_when_any_done="both")
    assert env.rollout(12, break_when_any_done=False).shape == (*env.batch_size, 12)
    dims = len(env.batch_size)
    for name in (name for name in dir(type(env)) if name.endswith("_spec_unbatched") and name[0] != "_"):
        spec, whole = getattr(env, name), getattr(env, name.removesuffix("_unbatched"))
        assert spec.shape == whole.shape[dims:], name
        assert spec.rand().shape == spec.shape


@pytest.mark.sample(4)
@every_case
def test_a_transform_works_around_a_vector_of_environments(case):
    env = TransformedEnv(SerialEnv(2, case.env), case.make())
    check_env_specs(env, break_when_any_done="both")
    assert env.rollout(12, break_when_any_done=False).shape == (2, *case.env().batch_size, 12)


@pytest.mark.sample(4)
@every_case
def test_a_transform_works_inside_a_vector_of_environments(case):
    env = SerialEnv(2, case.build)
    check_env_specs(env, break_when_any_done="both")
    assert env.rollout(12, break_when_any_done=False).shape == (2, *case.env().batch_size, 12)


def some(cases, fast):
    """The cases as a parameter; all but the ``fast`` ones are slow tests, because they take seconds."""
    values = [
        pytest.param(case, id=n, marks=() if n in fast else pytest.mark.slow) for n, case in cases.items()
    ]
    return pytest.mark.parametrize("case", values)


@some(AGENTS, fast=["ActionDelay, agents", "ServerNode"])
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


@pytest.mark.sample(2)
@every_case
def test_a_clone_shares_no_memory(case):
    env, control = case.build(), case.build()
    td, _ = begun(env), begun(control)
    clone = env.transform.clone()
    assert not memory(clone)
    other = TransformedEnv(case.env(), clone)
    onward(other, begun(other, seed=9), seed=9)
    assert all_same(onward(env, td.clone()), onward(control, td.clone()))


# Checkpoints.


@pytest.mark.sample(8)
@every_case
@pytest.mark.parametrize(("n_steps", "used"), [(5, True), (5, False), (0, True)])
@pytest.mark.parametrize("whole", [True, False], ids=["environment", "transform"])
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
    """Only random streams are loaded, so that it is all one whether the state or the reset comes first."""
    other, made = case.build(), []
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
    env, twin, other = case.build(), case.build(), case.build()
    td, _, _ = begun(env, 3), begun(twin, 3), begun(other, 5, seed=9)
    with pytest.warns(UserWarning, match="in the middle of an episode no state is loaded"):
        env.load_state_dict(saved_and_loaded(other.state_dict()))
    assert all_same(onward(env, td.clone()), onward(twin, td.clone()))


def saved_and_loaded(state):
    """A state after it was saved to a file and loaded from it."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@every_case
def test_all_memory_is_in_the_state_dict(case):
    env = case.build()
    begun(env)
    saved = {value.data_ptr() for value in memory(env.transform)}
    assert saved
    for module in env.transform.modules():
        kept = [v for k, v in module.__dict__.items() if isinstance(v, torch.Tensor) and k not in CONSTANT]
        assert not kept
        fixed = set(module._non_persistent_buffers_set)
        assert fixed <= CONSTANT


CONSTANT = {"chances", "_boundaries", "_delays", "codes", "_law_index", "_loss"}
"""Tensors that never change after construction."""


# Graphs.


@pytest.mark.sample(8)
@some(CASES, fast=AGENTS)
def test_a_step_compiles_into_one_graph_that_does_the_same(case):
    env, twin = case.build(), case.build()
    td, _ = begun(env), begun(twin)
    torch._dynamo.reset()
    compiled = torch.compile(whole_step(twin.transform), fullgraph=True, backend="eager")
    for _ in range(4):
        td = env.rand_action(td)
        after = env.base_env.step(td)["next"]
        one, other = whole_step(env.transform)(td, after.clone()), compiled(td, after.clone())
        assert same(one, other)
    assert all(a.equal(b) for a, b in zip(memory(env.transform), memory(twin.transform), strict=True))


def whole_step(transform):
    """A function that passes the inputs and then the outputs of a step through a transform."""

    def step(td, after):
        return transform._step(transform.inv(td), after)

    return step


# Collectors.


@pytest.mark.sample(5)
@every_case
def test_a_collector_returns_the_same_data_as_a_rollout(case):
    env, twin = case.build(), case.build()
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
    env, twin = case.build(), case.build()
    td, _ = begun(env, 2), begun(twin, 2)
    mask = torch.zeros(*env.batch_size, 1, dtype=torch.bool)
    mask[0] = True
    reset = env.reset(td.clone().set("_reset", mask))
    assert same(reset[1:], td[1:].select(*reset.keys(True, True)))
    torch.manual_seed(0)
    actions = twin.rand_action(td.clone()).select(*env.action_keys)
    outputs = [each.step(state.clone().update(actions))["next"] for each, state in ((env, reset), (twin, td))]
    assert same(outputs[0][1:], outputs[1][1:])


# Memory.


@pytest.mark.sample(4)
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


def storages(tensors: list[torch.Tensor]) -> set[int]:
    """Addresses of the memory of tensors."""
    return {tensor.untyped_storage().data_ptr() for tensor in tensors if tensor.numel()}
