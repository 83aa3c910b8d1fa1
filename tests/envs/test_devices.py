"""What a GPU would run, without a GPU: nothing waits for it, and it touches no tensor of another
device."""

from dataclasses import replace

import pytest
import torch
from delayed_envs import DELAYS, choices, delayed
from helpers import KINDS, MOTIONS, all_same, everything, play, square
from torch import Tensor
from torch._library.custom_ops import OPDEFS
from torch.utils._python_dispatch import TorchDispatchMode

from damian.common import compiling, devices
from damian.common.tensors import tree_map
from damian.delays.config import DelayConfig, LinkConfig
from damian.envs.delayed_env import DelayedEnv
from damian.transforms.base import StatefulTransform

LATE = DelayConfig(
    obs={
        "law": "geometric",
        "mean": 2,
    },
    rew="0..30",
)
LAG = {
    "law": "lag",
    "lag": "0..3",
    "update_period": 2,
}
LINKS = {
    "own": {
        "delay": DelayConfig(obs=2),
        "observation": replace(everything().observation, own=True),
    },
    "updown": {"links": LinkConfig("updown", delay=2, loss=0.1)},
    "matrix": {
        "links": LinkConfig(
            "matrix",
            delay=[[0, 1, LAG]] * 3,
            loss=0.1,
            range=100.0,
        ),
        "delay": LATE,
    },
}
SCENARIOS = {
    **{name: square(**sections) for name, sections in KINDS.items()},
    **{
        f"{name} in flight": square(motion=MOTIONS["polynomial"], **KINDS[name])
        for name in ("coverage", "energy")
    },
    **{
        name: everything(**sections)
        for name, sections in {
            **DELAYS,
            **LINKS,
        }.items()
    },
    "continuous": everything("polynomial", "continuous", delay=LATE),
}
every_scenario = pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=SCENARIOS)

WAITS = {
    "_local_scalar_dense",
    "is_nonzero",
    "item",
    "equal",
    "nonzero",
    "masked_select",
    "bincount",
}
WAITS |= {"_unique", "_unique2", "unique_dim", "unique_consecutive"}
"""Operators whose result, or its shape, a CPU must wait for."""
INDEXES = {"index", "index_put", "index_put_", "_index_put_impl_"}


def tensors(values):
    """All tensors within lists, tuples and dictionaries."""
    if isinstance(values, Tensor):
        yield values
    elif isinstance(values, list | tuple):
        for value in values:
            yield from tensors(value)
    elif isinstance(values, dict):
        yield from tensors(list(values.values()))


class Watched(TorchDispatchMode):
    """Watches every operator, also those within the custom operators of the package."""

    def check(self, name, func, args, out):
        raise NotImplementedError

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        kwargs = kwargs or {}
        if func.namespace == "damian":
            with self:
                return OPDEFS[f"damian::{name}"]._init_fn(*args, **kwargs)
        out = func(*args, **kwargs)
        self.check(name, func, [*args, kwargs], out)
        return out


class NothingWaits(Watched):
    """Refuses operators for which a CPU would wait for a GPU, and copies from the host."""

    def check(self, name, func, args, out):
        waits = name in WAITS or (name == "repeat_interleave" and func._overloadname == "Tensor")
        waits |= name in INDEXES and any(index.dtype == torch.bool for index in tensors(args[1]))
        assert not waits, f"waits for {func}"
        assert name != "lift_fresh", "copies numbers from the host"


class OnMeta(Watched):
    """Refuses tensors that are not on the device ``meta``, except for numbers."""

    def check(self, name, func, args, out):
        for tensor in tensors([args, out]):
            assert tensor.device.type == "meta" or not tensor.dim(), f"{func} on {tensor.device}"


class Recording(TorchDispatchMode):
    """Stands in for a CUDA graph: records operators, and runs them again on the same tensors, in
    place."""

    def __init__(self):
        super().__init__()
        self.calls = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.calls.append((func, args, kwargs or {}, func(*args, **kwargs or {})))
        return self.calls[-1][-1]

    def replay(self):
        for func, args, kwargs, found in self.calls:
            for old, new in zip(tensors([found]), tensors([func(*args, **kwargs)]), strict=True):
                if old.data_ptr() != new.data_ptr():
                    old.copy_(new)


def inputs(scenario):
    """An environment in the middle of an episode, the inputs of its next step, and worlds to
    reset."""
    env = delayed(scenario)
    assert isinstance(env, DelayedEnv)
    shown = play(env, choices(env, 3))
    stateful, others = env._split_transforms()
    assert not others
    memories = []
    entries = {("agents", "action"): choices(env, 1)[0]}
    for transform in stateful:
        memories.append(transform.memory)
        entries |= {key: shown[-1][key] for key in transform.action_keys if key not in entries}
    return (
        env,
        env.uav_env.worlds,
        memories,
        entries,
        torch.tensor([[True], [False], [True], [False]]),
    )


def step_and_reset(env, worlds, memories, entries, mask):
    """The outputs of a step, and of a reset of some worlds."""
    with torch.no_grad():
        worlds, memories, stepped = env.step_fn(worlds, memories, entries)
        return stepped, env.reset_fn(worlds, memories, mask.view(-1))[2]


@pytest.fixture
def no_data(monkeypatch):
    """The code that a device other than a CPU runs."""
    monkeypatch.setattr(devices, "data_dependent", lambda device: False)


@pytest.mark.sample(2)
@every_scenario
def test_no_step_and_no_reset_waits_for_the_device(scenario, no_data):
    arguments = inputs(scenario)
    with NothingWaits():
        step_and_reset(*arguments)


@pytest.mark.sample(3)
@every_scenario
def test_a_step_and_a_reset_touch_no_tensor_of_another_device(scenario, no_data):
    env, worlds, memories, entries, mask = inputs(scenario)
    uav_env = env.uav_env
    meta = torch.device("meta")
    uav_env.simulation.to(meta)
    uav_env.server.to(meta)
    uav_env._reset_outputs = {key: table.to(meta) for key, table in uav_env._reset_outputs.items()}
    for module in env.transform.modules():
        if isinstance(module, StatefulTransform):
            module.to(meta)
    worlds = tree_map(lambda table: table.to(meta), worlds)
    mask = mask.to(meta)
    moved = [
        {name: value.to(meta) for name, value in each.items()} for each in [*memories, entries]
    ]
    with OnMeta():
        step_and_reset(env, worlds, moved[:-1], moved[-1], mask)


@pytest.mark.parametrize("name", ["everything", "matrix", "continuous"])
def test_steps_replayed_as_a_graph_equal_steps(name, no_data, monkeypatch):
    monkeypatch.setattr(compiling, "compiled", lambda function, **options: function)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", Recording)
    monkeypatch.setattr(torch.cuda, "graph", lambda graph: graph)
    plain = delayed(SCENARIOS[name])
    env = delayed(SCENARIOS[name])
    object.__setattr__(env, "_compiled", compiling.CompiledMethods({}, cuda_graph=True))
    assert all_same(play(plain, choices(plain, 12)), play(env, choices(plain, 12)))
    assert any(function._calls > 3 for function in env._compiled._graphs.values())


@pytest.mark.parametrize("name", ["mixed", "everything", "matrix", "continuous", "belief"])
def test_both_ways_give_the_same_rollout(name, monkeypatch):
    outputs = []
    for dependent in (True, False):
        monkeypatch.setattr(
            devices, "data_dependent", lambda device, dependent=dependent: dependent
        )
        env = delayed(SCENARIOS[name])
        outputs.append(play(env, choices(env, 12)))
    rounding = 1e-5 if name == "belief" else 0.0  # sums over cells in another order
    assert all_same(*outputs, rounding)
