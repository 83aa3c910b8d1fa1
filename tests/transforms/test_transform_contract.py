"""Every transform works with vectors of environments, copies, checkpoints, graphs and collectors."""

import copy
import inspect
import io
import pickle

import pytest
import torch
from contract import (
    CASES,
    begun,
    cartpole,
    memory,
    onward,
    uavs,
    unserved,
)
from helpers import all_same, same
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, ParallelEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import RandomPolicy, check_env_specs

import damian.transforms
from damian.transforms import (
    StatefulTransform,
)

every_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
AGENTS = {name: case for name, case in CASES.items() if case.env in (uavs, unserved)}
AT_RESET = {name: case for name, case in CASES.items() if "Reward" not in name}
"""Cases whose transform reads outputs of a reset; there is no reward before the first step."""
BATCHED = {name: case for name, case in CASES.items() if case.env is not cartpole}
in_agents = pytest.mark.parametrize("case", AGENTS.values(), ids=AGENTS)


def test_the_cases_cover_every_exported_transform():
    exported = {name: getattr(damian.transforms, name) for name in damian.transforms.__all__}
    concrete = {
        name
        for name, value in exported.items()
        if inspect.isclass(value) and issubclass(value, Transform) and value is not StatefulTransform
    }
    assert concrete == {name.split(",")[0] for name in CASES}
    assert all(type(case.make()).__name__ == name.split(",")[0] for name, case in CASES.items())


# Places in which a transform works.


@every_case
def test_the_outputs_match_the_specs(case):
    env = case.build()
    check_env_specs(env, break_when_any_done="both")
    assert env.rollout(12, break_when_any_done=False).shape == (*env.batch_size, 12)


@pytest.mark.sample(2)
@every_case
def test_a_transform_does_the_same_in_a_compose_appended_or_around_a_transformed_environment(case):
    variants = [
        case.build(),
        TransformedEnv(case.env(), Compose(case.make())),
        TransformedEnv(case.env()).append_transform(case.make()),
        TransformedEnv(TransformedEnv(case.env()), case.make()),
    ]
    outputs = [onward(env, begun(env)) for env in variants]
    assert all(all_same(one, outputs[0]) for one in outputs[1:])


@pytest.mark.sample(2)
@every_case
def test_a_transform_works_around_a_vector_of_environments(case):
    env = TransformedEnv(SerialEnv(2, case.env), case.make())
    check_env_specs(env, break_when_any_done="both")
    assert env.rollout(12, break_when_any_done=False).shape == (2, *case.env().batch_size, 12)


@pytest.mark.sample(2)
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


@some({name: case for name, case in AGENTS.items() if case.env is uavs}, fast=["ActionDelay, agents"])
def test_a_transform_does_the_same_around_a_parallel_and_a_serial_environment(case):
    outputs = []
    for vector in (SerialEnv(2, case.env), ParallelEnv(2, case.env, mp_start_method="fork")):
        env = TransformedEnv(vector, case.make())
        try:
            outputs.append(onward(env, begun(env), 8))
        finally:
            env.close()
    assert all_same(*outputs)


@every_case
def test_outside_an_environment_the_error_says_what_to_do(case):
    transform = case.make()
    env = case.env()
    td = env.rand_step(env.reset())
    names = f"{type(transform).__name__}.*TransformedEnv"
    for use in (nn.Sequential(transform), Compose(transform), in_a_buffer(transform)):
        with pytest.raises(RuntimeError, match=names):
            use(td.clone())


def in_a_buffer(transform):
    """A function that stores data in a replay buffer with the transform, and samples it."""

    def use(td):
        data = td.unsqueeze(0).flatten()
        buffer = ReplayBuffer(storage=LazyTensorStorage(len(data)), transform=transform, batch_size=1)
        buffer.extend(data)
        buffer.sample()

    return use


@pytest.mark.parametrize("case", AT_RESET.values(), ids=AT_RESET)
def test_before_the_first_reset_a_step_is_refused(case):
    env = case.build()
    td = env.rand_action(env.base_env.reset())
    with pytest.raises(RuntimeError, match="reset"):
        env.step(td)


# Copies.


COPIES = {"pickle": lambda env: pickle.loads(pickle.dumps(env)), "deepcopy": copy.deepcopy}


@pytest.mark.sample(3)
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


def saved_and_loaded(state):
    """A state after it was saved to a file and loaded from it."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@every_case
def test_a_loaded_checkpoint_is_not_changed_by_later_steps(case):
    env = case.build()
    td = begun(env)
    saved = env.transform.state_dict()
    before = copy.deepcopy(saved)
    twin = case.make()
    twin.load_state_dict(saved)
    env.transform.load_state_dict(twin.state_dict())
    onward(TransformedEnv(copy.deepcopy(env.base_env), twin), td)
    assert saved.keys() == before.keys()
    assert all(saved[key].equal(before[key]) for key in saved)


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


# Gradients.


@every_case
def test_the_autograd_graph_does_not_grow_during_a_rollout(case):
    env = case.build()
    td, weight, sizes = begun(env, 0), torch.ones((), requires_grad=True), []
    for t in range(24):
        td = env.rand_action(td)
        for key in env.action_keys:
            if td[key].is_floating_point():
                td.set(key, td[key] * weight)
        after, td = env.step_and_maybe_reset(td)
        assert not any(value.requires_grad for value in memory(env.transform)), t
        sizes.append(sum(nodes(value) for value in after["next"].values(True, True)))
    assert max(sizes[12:]) <= max(sizes[:12])


def nodes(value):
    """Number of nodes in the autograd graph of a tensor."""
    found, pending = set(), [value.grad_fn]
    while pending:
        node = pending.pop()
        if node is not None and node not in found:
            found.add(node)
            pending += [before for before, _ in node.next_functions]
    return len(found)


# Collectors.


@pytest.mark.sample(3)
@every_case
def test_a_collector_returns_the_same_data_as_a_rollout(case):
    env, twin = case.build(), case.build()
    for each in (env, twin):
        each.set_seed(0)
        each.transform.set_seed(0)
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
