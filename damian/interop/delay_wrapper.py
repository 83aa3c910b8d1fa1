"""A wrapper that delays observations and actions of any Gymnasium environment, whatever their spaces."""

import copy
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Space
from gymnasium.vector.utils import batch_space, create_empty_array, iterate

from damian.common import counter_rng
from damian.common.errors import InputError
from damian.delays.laws import sampler_of
from damian.delays.line import DelayLine, Memory
from damian.transforms.context import ContextReader


class DelayWrapper(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Delays what the agent observes, what it does, or both, as ``ObservationDelay`` and ``ActionDelay`` do.

    The agent holds the observation that was made last among those that have arrived, at first that of the
    reset; ``info["age"]`` is its age [steps]. The environment executes the action that was chosen last among
    those that have arrived, until then ``default``. Rewards and the end of an episode are not late. With
    delay 0 nothing changes. Many environments: ``gymnasium.make_vec(..., wrappers=[...])``.

    Args:
        env: any Gymnasium environment; its spaces stay as they are.
        observation, action: delay of each: steps (``3``), a time (``"3s"``), a distribution
            (``Uniform(3, 7)``), or a function, as ``ObservationDelay`` takes.
        loss: probability that an observation never arrives.
        default: the action that is executed until the first one arrives; if not given, 0 (in all parts). It
            is not needed if no action is late.
        dt: length of a step [s], for delays given as times.

    Examples:
        >>> env = DelayWrapper(gymnasium.make("Pendulum-v1"), observation=Uniform(1, 4), action=2)
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        observation: Any = 0,
        action: Any = 0,
        *,
        loss: float = 0.0,
        default: Any = None,
        dt: float = 1.0,
    ) -> None:
        told = {"observation": observation, "action": action, "loss": loss, "default": default, "dt": dt}
        gymnasium.utils.RecordConstructorArgs.__init__(self, **told)
        super().__init__(env)
        self._observations = _Link("observation", observation, loss, dt)
        self._actions = _Link("action", action, 0.0, dt, before_step=True)
        if default is None and self._actions.late:
            default = _zero(env.action_space)
        self._default = default

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._actions.reset(self._default, seed)
        self._observations.reset(observation, seed)
        return copy.deepcopy(observation), info | {"age": 0}

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        executed, _ = self._actions.send(action)
        observation, reward, terminated, truncated, info = self.env.step(executed)
        held, age = self._observations.send(observation)
        return copy.deepcopy(held), reward, terminated, truncated, info | {"age": age}


class _Link:
    """One link: a ``DelayLine`` delays the times at which things were sent, so that they may be anything."""

    def __init__(self, name: str, delay: Any, loss: float, dt: float, before_step: bool = False) -> None:
        sampler = sampler_of(delay, dt, loss, name)
        self.late = sampler.late
        self._line, self._name = DelayLine(sampler, "generation"), name
        self._contexts = ContextReader(sampler, None, dt, name, before_step)
        self._memory: Memory | None = None
        self._sent: dict[int, Any] = {}

    def reset(self, first: Any, seed: int | None) -> None:
        """Begin an episode in which ``first`` is held; a seed decides all later delays."""
        if self._memory is None or seed is not None:
            entropy = np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]
            name = torch.tensor([counter_rng.number_of(self._name)])
            streams = counter_rng.bits64(torch.from_numpy(entropy[None].view(np.int64)), name)
            memory = self._line.init_memory([torch.zeros(1, dtype=torch.long)], streams)
            self._memory = memory | {"agents": torch.zeros(1, dtype=torch.long)}
        now = self._memory["clock"]
        self._memory, _ = self._line.reset(self._memory, [now], torch.tensor([True]))
        self._sent = {int(now): first}

    def send(self, thing: Any) -> tuple[Any, int]:
        """Send a thing; returns the one that is held now, and its age [steps]."""
        if self._memory is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        now = self._memory["clock"] + 1
        self._sent[int(now)] = thing
        context = self._contexts.read(self._memory, {}, None, torch.Size([1]))
        self._memory, delivery = self._line.step(self._memory, [now], None, context)
        held, oldest = int(delivery.held[0]), int(now) - self._line.sampler.longest
        # What was sent before the held one is never held again, and what has not arrived by now never does.
        self._sent = {t: each for t, each in self._sent.items() if t == held or t > max(held, oldest)}
        return self._sent[held], int(delivery.age)


def _zero(space: Space[Any]) -> Any:
    """The action 0 of a space."""
    zero = next(iter(iterate(batch_space(space, 1), create_empty_array(space, 1))))
    if not space.contains(zero):
        raise InputError(f"default: is missing, and {space} has no action 0")
    return zero
