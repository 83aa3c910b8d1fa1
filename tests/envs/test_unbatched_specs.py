"""Every spec without the batch dimension, as TorchRL's models and replay buffers ask for it."""

import pytest
from delayed_envs import DELAYS
from helpers import MOTIONS, everything, square
from torchrl.data import Composite
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from damian.envs.pipeline import make_env
from damian.envs.uav_env import ALL_EXTRAS, UavEnv

NAMES = [name for name in dir(EnvBase) if name.endswith("_unbatched")]
N_WORLDS = 5
"""Another number than that of the UAVs, so that no dimension is taken for another one."""


def check_unbatched(env: EnvBase) -> None:
    """Compare every spec without the batch with the one with it."""
    assert len(NAMES) > 10
    assert env.batch_size == (N_WORLDS,)
    for name in NAMES:
        check_shapes(name, getattr(env, name), getattr(env, name.removesuffix("_unbatched")))
    check_env_specs(env, break_when_any_done="both")


def check_shapes(name, unbatched, batched):
    assert unbatched.shape == batched.shape[1:], name
    value = unbatched.rand()
    assert value.shape == unbatched.shape, name
    assert unbatched.is_in(value), name
    if isinstance(unbatched, Composite):
        assert set(unbatched.keys(True, True)) == set(batched.keys(True, True)), name
        for key in batched.keys(True, True):
            check_shapes(f"{name} {key}", unbatched[key], batched[key])
    else:
        assert unbatched.dtype == batched.dtype, name


@pytest.mark.parametrize("extras", [(), ALL_EXTRAS], ids=["without extras", "all extras"])
@pytest.mark.parametrize("kind", ["discrete", "continuous"])
@pytest.mark.parametrize("motion", MOTIONS)
def test_the_environment_has_every_spec_without_its_batch(motion, kind, extras):
    check_unbatched(UavEnv(everything(motion, kind), N_WORLDS, extras=extras))


@pytest.mark.parametrize("extras", [(), ALL_EXTRAS], ids=["without extras", "all extras"])
@pytest.mark.parametrize("delays", [{}, *DELAYS.values()], ids=["none", *DELAYS])
def test_the_environment_with_delays_has_every_spec_without_its_batch(delays, extras):
    check_unbatched(make_env(square(**delays), N_WORLDS, extras=extras))
