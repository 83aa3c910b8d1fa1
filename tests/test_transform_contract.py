"""What every transform keeps to, whatever TorchRL does with it: vectors, copies, checkpoints, graphs."""

import copy
import inspect
import io
import pickle

import pytest
import torch
from contract import CASES, DRAWS, LATE, REWARD, SEEN, Case, Drift, begun, memory, onward, uavs, unserved
from helpers import all_same, same, square
from tensordict import TensorDict
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, ParallelEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

import damian.transforms
from damian.delayed import DelayedEnv
from damian.errors import InputError
from damian.transforms import *

every_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES)


def test_the_contract_covers_every_transform():
    exported = {name: getattr(damian.transforms, name) for name in damian.transforms.__all__}
    concrete = {
        name for name, what in exported.items()
        if inspect.isclass(what) and issubclass(what, Transform) and what is not Stateful
    }
    assert concrete == {name.split(",")[0] for name in CASES}
    assert all(type(case.make()).__name__ == name.split(",")[0] for name, case in CASES.items())


# Where a transform may stand.


@every_case
def test_a_single_environment_keeps_to_its_specs(case):
    env = case.build()
    check_env_specs(env, break_when_any_done="both")
    assert env.rollout(12, break_when_any_done=False)["next", "done"].shape[-2] == 12


@every_case
def test_composed_and_appended_a_transform_does_the_same(case):
    variants = [
        case.build(),
        TransformedEnv(case.env(), Compose(Compose(case.make()))),
        TransformedEnv(case.env()).append_transform(case.make()),
        TransformedEnv(TransformedEnv(case.env()), case.make()),
    ]
    shown = [onward(env, begun(env)) for env in variants]
    assert all(all_same(one, shown[0]) for one in shown[1:])


@every_case
def test_around_a_vector_of_environments_it_works(case):
    env = TransformedEnv(SerialEnv(2, case.env), case.make())
    check_env_specs(env, break_when_any_done="both")
    assert env.rollout(12, break_when_any_done=False).shape == (2, *case.env().batch_size, 12)


@every_case
def test_inside_a_vector_of_environments_it_works(case):
    env = SerialEnv(2, case.build)
    check_env_specs(env, break_when_any_done="both")
    assert env.rollout(12, break_when_any_done=False).shape == (2, *case.env().batch_size, 12)


@every_case
def test_worker_processes_do_what_a_loop_does(case):
    shown = []
    for vector in (SerialEnv(2, case.build), ParallelEnv(2, case.build, mp_start_method="fork")):
        try:
            shown.append(onward(vector, begun(vector)))
        finally:
            vector.close()
    assert all_same(*shown)
