"""What the wrappers share: a scenario's environment whose entries are NumPy arrays, and its
spaces."""

from typing import Any, NamedTuple, cast

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete, Space
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical
from torchrl.envs.utils import step_mdp

from damian import keys
from damian.common import checks
from damian.common.errors import InputError
from damian.envs.config import ScenarioConfig
from damian.envs.pipeline import make_env
from damian.envs.uav_env import EXTRAS
from damian.show.film import LiveFilm

RENDER_MODES = ("rgb_array",)
METADATA: dict[str, Any] = {"render_modes": [*RENDER_MODES], "render_fps": 4}
Array = NDArray
Infos = dict[str, Any]
"""What Gymnasium tells beside an observation, by name."""


class Instant(NamedTuple):
    """What B worlds with N UAVs output after a step or a reset; rewards and flags are 0 after a
    reset."""

    observation: Array
    """What the actors observe, float32, [B, N, F]."""
    reward: Array
    """Rewards as the server perceives them, float32, [B, N]."""
    terminated: Array
    """Whether the episode has ended by its task, [B] bool."""
    truncated: Array
    """Whether it has reached its time limit, [B] bool."""
    infos: dict[str, Array]
    """``ready`` [B, N] and ``is_success`` [B] bool, and if masked ``action_mask`` [B, N, A]
    int8."""


class Flight:
    """A scenario's environment, with its delays, stepped with NumPy arrays; ``seed`` as in
    ``UavGymEnv``."""

    _now: TensorDictBase
    """What the environment has output last, with which its next step begins; there after a
    reset."""

    def __init__(
        self,
        scenario: ScenarioConfig,
        num_worlds: int,
        seed: int,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None:
            checks.one_of("render_mode", render_mode, RENDER_MODES)
        self.env = make_env(scenario, num_worlds, seed, extras=EXTRAS if render_mode else ())
        self.film = LiveFilm(self.env.uav_env) if render_mode else None

    def observation_space(self, agent: int) -> Box:
        """What an agent observes, [F]."""
        return self._box(keys.OBSERVATION, agent)

    def action_space(self) -> Space:
        """What an agent chooses: one of A actions, or a distance and a heading in [0, 1]."""
        spec = self.env.full_action_spec[keys.ACTION]
        return (
            Discrete(spec.space.n)
            if isinstance(spec, Categorical)
            else Box(0.0, 1.0, (2,), np.float32)
        )

    @torch.no_grad()
    def reset(self, seed: int | None) -> Instant:
        """Begin a new episode in every world; with a seed, world number i draws from ``seed +
        i``."""
        if seed is not None:
            self.env.seed_worlds(seed + torch.arange(self.env.batch_size[0]))
        self._now = self.env.reset()
        if self.film:
            self.film.reset(self._now)
        return _instant(self._now)

    @torch.no_grad()
    def step(self, action: Array, *, reset: bool = False) -> tuple[Instant, Instant]:
        """Take a step, and if ``reset`` begin new episodes; its outputs, and those that come
        next."""
        self._now[keys.ACTION] = torch.as_tensor(action)
        if reset:
            stepped, self._now = self.env.step_and_maybe_reset(self._now)
        else:
            stepped = self.env.step(self._now)
            self._now = step_mdp(stepped)
        after = stepped["next"]
        if self.film:
            self.film.add(after)
        return _instant(after), _instant(self._now)

    def render(self) -> Array | None:
        """A picture of this instant, [height, width, 3] uint8; None without a render mode."""
        return self.film.picture() if self.film else None

    def state(self) -> Array:
        """What a central critic observes of the first world, from the messages at the server,
        [N G]."""
        return self._now[keys.GLOBAL_OBSERVATION][0].flatten().numpy().copy()

    def state_space(self) -> Box:
        """The space of ``state``."""
        return self._box(keys.GLOBAL_OBSERVATION, slice(None))

    def _box(self, key: NestedKey, agents: int | slice) -> Box:
        """The bounds of an entry [B, N, F] of one agent, or of several, as one row."""
        limits = cast(Any, self.env.full_observation_spec[key]).space
        low, high = (limit[0, agents].flatten().numpy() for limit in (limits.low, limits.high))
        return Box(low, high, dtype=np.float32)


def _instant(outputs: TensorDictBase) -> Instant:
    """The outputs of a step or a reset as arrays of their own."""

    def array(key: NestedKey) -> Array:
        return cast(Tensor, outputs[key]).numpy().copy()

    observation = array(keys.OBSERVATION)
    infos = {"ready": array(keys.READY), "is_success": array(keys.SUCCESS)[:, 0]}
    if keys.ACTION_MASK in outputs.keys(True, True):
        infos["action_mask"] = array(keys.ACTION_MASK).astype(np.int8)
    reward = outputs.get(keys.REWARD, None)
    rewards = (
        np.zeros(observation.shape[:2], np.float32)
        if reward is None
        else reward[..., 0].numpy().copy()
    )
    return Instant(
        observation, rewards, array(keys.TERMINATED)[:, 0], array(keys.TRUNCATED)[:, 0], infos
    )


def actions_in(space: Space, key: str, given: Any) -> Array:
    """Actions as an array of the type of a space; refused if they do not lie in it."""
    found = np.asarray(given).astype(space.dtype, casting="same_kind")
    if not space.contains(found):
        raise InputError(f"{key}: {given} is not in {space}")
    return found


def row(infos: dict[str, Array], world: int, agent: int) -> Infos:
    """The infos of one UAV, copied; flags are Python's: Gymnasium's vector environments know no
    others."""
    found = {
        n: each[world] if n == "is_success" else each[world, agent] for n, each in infos.items()
    }
    return {name: each.copy() if each.ndim else each.item() for name, each in found.items()}
