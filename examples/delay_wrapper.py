"""A wrapper that delays observations, actions and rewards of any Gymnasium environment.

    import gymnasium
    from delay_wrapper import DelayWrapper

    from damian import Uniform

    late = {"observation": Uniform(1, 4), "action": 1, "reward": 2, "loss": 0.1}
    env = DelayWrapper(gymnasium.make("CartPole-v1"), **late, timeline=8, history=6)
    observation, info = env.reset(seed=0)  # the seed decides the delays, too
    observation, reward, *_, info = env.step(0)
    print(info["age"], info["received"])  # of the observation [steps], and of each reward
    print(observation["timeline"], observation["action_history"])

In a vector environment each world is wrapped (``make_vec(..., wrappers=[...])``); many worlds as
one batch are what the transforms of ``damian.transforms`` are for.
"""

import copy
import math
from collections.abc import Mapping
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Space, flatten, flatten_space
from gymnasium.vector.utils import batch_space, create_empty_array, iterate

from damian.common import checks, counter_rng
from damian.common.errors import InputError
from damian.common.text_files import listed
from damian.delays.laws import LOSES, sampler_of
from damian.transforms.context import ContextReader


class DelayWrapper(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """Delays observations, actions and rewards as the transforms do, for spaces of any kind.

    The agent holds the observation that was made last among those that have arrived, at first that
    of the reset; ``info["age"]`` is its age [steps]. The environment executes the action that was
    chosen last among those that have arrived, until then ``default``. Rewards that arrive in the
    same step are added up, in the last step of an episode all that are in transit;
    ``info["received"]`` lists pairs of age [steps] and reward. The end of an episode is not late.
    With delay 0 nothing changes.

    Args:
        env: any Gymnasium environment, with its time limit.
        observation, action, reward: delay of each: steps (``3``), a time (``"3s"``), a distribution
            (``Uniform(3, 7)``), or a function, as ``ObservationDelay`` takes. The parts of a
            ``Dict`` may be messages of their own, with laws by name
            (``{"camera": 3, "gps": 0}``); those not named are not late.
        loss: probability that an observation never arrives; also by part.
        history, timeline: numbers of steps K. With either, the observation is a ``Dict`` with
            ``observation`` (or its own entries), ``age`` [1], ``action_history`` [K * A] as
            ``ActionHistory`` writes it, with discrete actions one-hot, and ``timeline`` [K, D + 1]
            as ``ObservationTimeline`` does (float32). Parts have ages of their own, and lie in the
            timeline side by side, each with its mark.
        default: the action that is executed until the first one arrives, and fills the history at
            first; if not given, 0 (in all parts). It is not needed if no action is late and there
            is no history.
        dt: length of a step [s], for delays given as times.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        observation: Any = 0,
        action: Any = 0,
        reward: Any = 0,
        *,
        loss: Any = 0.0,
        history: int = 0,
        timeline: int = 0,
        default: Any = None,
        dt: float = 1.0,
    ) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(
            self,
            observation=observation,
            action=action,
            reward=reward,
            loss=loss,
            history=history,
            timeline=timeline,
            default=default,
            dt=dt,
        )
        super().__init__(env)
        checks.whole("history", history, 0, unit="steps")
        checks.whole("timeline", timeline, 0, unit="steps")
        self._history = history
        self._timeline = timeline
        space: Any = env.observation_space
        named = _by_name(observation) or _by_name(loss)
        self._in_parts = isinstance(space, Dict) and named
        self._spaces: dict[str, Space] = space.spaces if self._in_parts else {"": space}
        laws = self._of_parts("observation", observation)
        losses = self._of_parts("loss", loss)
        self._observations = {
            part: _Link("observation", laws[part], losses[part], dt, timeline, part)
            for part in self._spaces
        }
        self._actions = _Link("action", action, 0.0, dt, history)
        self._rewards = _Link("reward", reward, 0.0, dt)
        checks.require(not self._rewards.sampler.loses, "reward", reward, LOSES)
        if default is None and (history or self._actions.sampler.late):
            default = _zero(env.action_space)
        self._default = copy.deepcopy(default)
        added: dict[str, tuple[int, ...]] = {}
        if timeline:
            self._widths = {
                part: len(_flat("timeline", each).low) + 1 for part, each in self._spaces.items()
            }
            added["timeline"] = (timeline, sum(self._widths.values()))
        if history:
            self._low, self._range = _bounds(_flat("history", env.action_space))
            added["action_history"] = (history * len(self._low),)
        if added:
            added["age"] = (len(self._spaces),)
            entries = space.spaces if isinstance(space, Dict) else {"observation": space}
            taken = sorted(added.keys() & entries.keys())
            should = "is an entry of it already: rename that"
            checks.require(not taken, "observation", listed(taken), should)
            boxes = {name: Box(-np.inf, np.inf, shape) for name, shape in added.items()}
            self.observation_space = Dict({**entries, **boxes})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        for part, first in self._parts_of(observation).items():
            self._observations[part].reset(first, seed)
        self._actions.reset(self._default, seed)
        self._rewards.reset(0.0, seed)
        told, age = self._told()
        return told, info | {"age": age}

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        self._actions.send(action)
        observation, reward, terminated, truncated, info = self.env.step(self._actions.held())
        for part, made in self._parts_of(observation).items():
            self._observations[part].send(made)
        told, age = self._told()
        info = info | {"age": age}
        if self._rewards.sampler.late:
            self._rewards.send(reward)
            ended = terminated or truncated
            received = [
                (age, earned)
                for age, (earned, wait) in self._rewards.recent().items()
                if wait == 0 or (ended and wait > 0)
            ]
            info["received"] = received
            reward = float(sum(earned for _, earned in received))
        return told, reward, terminated, truncated, info

    def _of_parts(self, key: str, law: Any) -> dict[str, Any]:
        """The law of each part, from one for all or from some by name."""
        if not _by_name(law):
            return dict.fromkeys(self._spaces, law)
        unknown = [name for name in law if name not in self._spaces]
        checks.require(not unknown, key, listed(unknown), "is no part of the observation")
        return {part: law.get(part, 0) for part in self._spaces}

    def _parts_of(self, observation: Any) -> dict[str, Any]:
        """The parts of an observation that are messages of their own, by name."""
        return observation if self._in_parts else {"": observation}

    def _told(self) -> tuple[Any, Any]:
        """The observation that the agent holds, and its age [steps]; for each part of a ``Dict``
        whose parts are messages of their own."""
        links = self._observations
        told: Any = {part: link.held() for part, link in links.items()}
        age: Any = {part: link.age for part, link in links.items()}
        ages = np.array([*age.values()], np.float32)
        if not self._in_parts:
            told = told[""]
            age = age[""]
        if self._timeline or self._history:
            own = told if isinstance(told, Mapping) else {"observation": told}
            told = {**own, "age": ages}
        if self._timeline:
            slots = [self._slots(part) for part in links]
            told["timeline"] = np.concatenate(slots, -1)
        if self._history:
            told["action_history"] = self._chosen()
        return told, age

    def _slots(self, part: str) -> np.ndarray:
        """The timeline of a part, [K, D + 1]."""
        slots: Any = np.zeros((self._timeline, self._widths[part]), np.float32)
        for age, (made, wait) in self._observations[part].recent().items():
            if age < self._timeline and wait <= 0:
                slots[age, :-1] = flatten(self._spaces[part], made)
                slots[age, -1] = 1
        return slots

    def _chosen(self) -> np.ndarray:
        """The latest actions in [0, 1], [K * A]."""
        sent = self._actions.recent()
        chosen = []
        for age in reversed(range(self._history)):
            action, _ = sent.get(age, (self._default, 0))
            numbers = np.asarray(flatten(self.env.action_space, action), np.float32)
            chosen.append((numbers - self._low) / self._range)
        return np.concatenate(chosen)


class _Link:
    """The messages of one sender. When each arrives is drawn as it is sent, so that they may be
    anything.

    It keeps copies, and gives copies, because environments and agents may write over their arrays.
    Those of the latest ``kept`` steps are kept after they have arrived, too.
    """

    def __init__(
        self, key: str, law: Any, loss: float, dt: float, kept: int = 0, part: str = ""
    ) -> None:
        self.sampler = sampler_of(law, dt, loss, key)
        self._contexts = ContextReader(self.sampler, None, dt, key, before_step=key == "action")
        self._number = torch.tensor([counter_rng.number_of(f"{key} {part}".strip())])
        self._kept = max(kept, self.sampler.longest)
        self._memory: dict[str, torch.Tensor] = {}
        self._sent: dict[int, tuple[Any, float]] = {}
        """What was sent, and when it arrives, by the time [steps]."""
        self._now = 0

    def reset(self, first: Any, seed: int | None) -> None:
        """Begin an episode, whose first message is known at once; a seed decides all later
        delays."""
        if not self._memory or seed is not None:
            entropy = np.random.SeedSequence(seed).generate_state(1, np.uint64)
            world = torch.from_numpy(entropy.view(np.int64))
            streams = counter_rng.bits64(world, self._number)
            zero = torch.zeros_like(streams)
            state = self.sampler.initial_state(streams)
            self._memory = {"streams": streams, "clock": zero, "agents": zero, "state": state}
        memory = self._memory
        memory["reset_at"] = memory["clock"]
        everywhere = torch.ones(1, dtype=torch.bool)
        memory["state"] = self.sampler.begin_episode(memory["state"], everywhere)
        self._now = 0
        self._sent = {0: (copy.deepcopy(first), 0)}

    def send(self, thing: Any) -> None:
        """Send a thing in the next step."""
        if not self._sent:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        self._now += 1
        due: float = self._now
        if self.sampler.late:
            memory = self._memory
            context = self._contexts.read(memory, {}, None, torch.Size([1]))
            memory["clock"] = memory["clock"] + 1
            delay, memory["state"] = self.sampler(
                memory["streams"], memory["clock"], memory["state"], context
            )
            due += delay.item() if delay < self.sampler.lost else math.inf
        self._sent[self._now] = copy.deepcopy(thing), due
        # What is neither recent nor held is never asked for again.
        recent = self._now - self._kept
        held = self._now - self.age
        self._sent = {t: each for t, each in self._sent.items() if t >= recent or t == held}

    @property
    def age(self) -> int:
        """Age of what is held: what was sent last among all that has arrived [steps]."""
        return min(age for age, (_, wait) in self.recent().items() if wait <= 0)

    def held(self) -> Any:
        """What is held."""
        return copy.deepcopy(self.recent()[self.age][0])

    def recent(self) -> dict[int, tuple[Any, float]]:
        """What was sent lately, and the time until it arrives, by age [steps]."""
        now = self._now
        return {now - time: (thing, due - now) for time, (thing, due) in self._sent.items()}


def _flat(key: str, space: Space) -> Box:
    """The space of the numbers of what is in a space."""
    flat = flatten_space(space)
    if not isinstance(flat, Box):
        raise InputError(f"{key}: {space} has no vectors of a fixed length")
    return flat


def _bounds(flat: Box) -> tuple[np.ndarray, np.ndarray]:
    """The lower bound and the width of each of A numbers, 0 and 1 if they have no bounds, [A]."""
    with np.errstate(over="ignore"):  # a bound may be the largest number
        low = np.float32(flat.low)
        width = np.float32(flat.high) - low
    bounded = np.isfinite(width)
    low = np.where(bounded, low, np.float32(0))
    return low, np.where(bounded & (width > 0), width, np.float32(1))


def _by_name(law: Any) -> bool:
    """Whether laws are given by name, and not one for all."""
    return isinstance(law, Mapping) and "law" not in law


def _zero(space: Space) -> Any:
    """The action 0 of a space."""
    zeros = create_empty_array(space, 1)
    zero = next(iter(iterate(batch_space(space, 1), zeros)))
    if not space.contains(zero):
        raise InputError(f"default: is missing, and {space} has no action 0")
    return zero
