"""Delays of what agents observe, do and earn, whatever their spaces are, and a wrapper for
Gymnasium."""

import copy
import math
from collections.abc import Collection, Mapping
from typing import Any, SupportsFloat, cast

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Space, flatten, flatten_space
from gymnasium.vector.utils import batch_space, create_empty_array, iterate
from numpy.typing import NDArray

from damian.common import checks, counter_rng
from damian.common.errors import InputError
from damian.common.text_files import listed
from damian.delays.laws import LOSES, sampler_of
from damian.delays.line import DelayLine, Memory
from damian.delays.samplers import LinkSampler, Sampler, streams_for
from damian.transforms.context import ContextReader

ByName = dict[str, Any]
"""Something of each agent, or of each part of an observation; the only one is called ``""``."""
Told = tuple[ByName, ByName]
"""What agents are told, and their infos."""
Numbers = NDArray[np.float32]
Sent = dict[int, tuple[Any, float]]
"""Things that were sent, each with a time, by time."""


class DelayWrapper(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """Delays what the agent observes, does and earns, as the transforms do, whatever the spaces
    are.

    The agent holds the observation that was made last among those that have arrived, at first that
    of the reset; ``info["age"]`` is its age [steps]. The environment executes the action that was
    chosen last among those that have arrived, until then ``default``. Rewards that arrive in the
    same step are added up, in the last step of an episode all that are in transit;
    ``info["received"]`` lists pairs of age [steps] and reward. The end of an episode is not late.
    With delay 0 nothing changes.

    Args:
        env: any Gymnasium environment, with its time limit; many:
            ``make_vec(..., wrappers=[...])``.
        observation, action, reward: delay of each: steps (``3``), a time (``"3s"``), a distribution
            (``Uniform(3, 7)``), or a function, as ``ObservationDelay`` takes. The parts of a
            ``Dict`` may be messages of their own, with laws by name; those not named are not late.
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

    Examples:
        >>> env = DelayWrapper(gymnasium.make("Pendulum-v1"), observation=Uniform(1, 4), action=2, history=6)
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
        told: ByName = {
            "observation": observation,
            "action": action,
            "reward": reward,
            "loss": loss,
            "history": history,
            "timeline": timeline,
            "default": default,
            "dt": dt,
        }
        gymnasium.utils.RecordConstructorArgs.__init__(self, **told)
        super().__init__(env)
        space: Any = env.observation_space
        named = _by_name(observation) or _by_name(loss)
        self._in_parts = isinstance(space, Dict) and named
        observed = space.spaces if self._in_parts else {"": space}
        told["default"] = {} if default is None else {"": default}
        self._delays = Delays(observed, {"": env.action_space}, told)
        self.observation_space = self._delays.space("", space)

    def reset(self, *, seed: int | None = None, options: ByName | None = None) -> tuple[Any, dict]:
        observation, info = self.env.reset(seed=seed, options=options)
        observed = observation if self._in_parts else {"": observation}
        told, more = self._delays.reset(observed, seed)
        return told[""], info | more[""]

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, ByName]:
        executed = self._delays.act({"": action})[""]
        observation, reward, terminated, truncated, info = self.env.step(executed)
        ended = [""] if terminated or truncated else []
        observed = observation if self._in_parts else {"": observation}
        told, rewards, more = self._delays.step(observed, {"": reward}, ended)
        return told[""], rewards[""], terminated, truncated, info | more[""]


class Delays:
    """What some agents observe, do and earn, late: the wrappers pass it through here in each step.

    ``acting`` has the spaces of the actions by agent; ``observed`` those of the observations by
    agent, or by part if these are messages of their own; ``told`` the arguments of a wrapper,
    ``default`` by agent. An agent that joins, or joins again, begins anew. Others may write over
    what they give or get.
    """

    def __init__(self, observed: ByName, acting: ByName, told: ByName) -> None:
        for name in ("history", "timeline"):
            checks.whole(name, told[name], 0, unit="steps")
        self._history = told["history"]
        self._timeline = told["timeline"]
        self._parts: dict[str, list[str]] = {}
        for agent in acting:
            self._parts[agent] = [agent] if agent in observed else [*observed]
        self._observations = _Link("observation", observed, told)
        self.actions = _Link("action", acting, told)
        self._rewards = _Link("reward", acting, told)
        checks.require(not self._rewards.sampler.loses, "reward", told["reward"], LOSES)
        needed = self.actions.sampler.late or self._history
        default = dict(told["default"])
        for agent, space in acting.items():
            if agent not in default:
                default[agent] = _zero(space) if needed else None
        self._default = copy.deepcopy(default)
        self.present: set[str] = set()
        """Agents whose episode goes on."""
        self._messages: ByName = {}
        if self._timeline:
            self._messages = {part: _flat("timeline", each) for part, each in observed.items()}
        self._chosen: ByName = {}
        if self._history:
            self._chosen = {agent: _flat("history", each) for agent, each in acting.items()}

    def space(self, agent: str, space: Space) -> Space:
        """The space of what an agent is told, whose observations are in ``space``."""
        added = self._added(agent)
        if not added:
            return space
        entries = dict(space.spaces) if isinstance(space, Dict) else {"observation": space}
        taken = sorted(added.keys() & entries.keys())
        checks.require(
            not taken, "observation", listed(taken), "is an entry of it already: rename that"
        )
        added = {name: Box(-np.inf, np.inf, each.shape) for name, each in added.items()}
        return Dict(entries | added)

    def reset(self, observations: ByName, seed: int | None) -> Told:
        """What agents are told first, and their infos; a seed decides all later delays."""
        for link in (self._observations, self.actions, self._rewards):
            link.reset(seed)
        self.present = set()
        return self.begin(observations)

    def begin(self, observations: ByName) -> Told:
        """The same where the episodes of some agents begin."""
        agents = self._agents(observations)
        self.present |= {*agents}
        self._observations.begin(observations)
        self.actions.begin({agent: self._default[agent] for agent in agents})
        self._rewards.begin(dict.fromkeys(agents, 0.0))
        return self._told(agents)

    def act(self, actions: ByName) -> ByName:
        """What is executed when agents choose these actions."""
        sent = {agent: action for agent, action in actions.items() if agent in self.present}
        self.actions.send(sent)
        executed = {agent: self.actions.held(agent) for agent in sent}
        return {**actions, **executed}

    def step(
        self, observations: ByName, rewards: ByName, ended: list[str]
    ) -> tuple[ByName, ByName, ByName]:
        """What agents are told, receive, and their infos; the episodes of some have ``ended``."""
        agents = self._agents(observations)
        rewards = dict(rewards)
        self._observations.send(observations)
        if joining := {*agents} - self.present:
            parts = (part for agent in joining for part in self._parts[agent])
            self.begin({part: observations[part] for part in parts})
        told, infos = self._told(agents)
        if self._rewards.sampler.late:
            self._rewards.send(rewards)
            for agent in rewards:
                received = []
                for age, (reward, wait) in self._rewards.recent(agent).items():
                    if wait == 0 or (wait > 0 and agent in ended):
                        received.append((age, reward))
                infos[agent]["received"] = received
                rewards[agent] = float(sum(reward for _, reward in received))
        self.present -= {*ended}
        return told, rewards, infos

    def _agents(self, observations: ByName) -> list[str]:
        """The agents of whom there are observations."""
        return [agent for agent, parts in self._parts.items() if observations.keys() >= {*parts}]

    def _told(self, agents: list[str]) -> Told:
        """What agents are told, and their infos."""
        link = self._observations
        told = {}
        infos = {}
        for agent in agents:
            parts = self._parts[agent]
            found = {part: link.held(part) for part in parts}
            age = {part: link.age[part] for part in parts}
            if agent in found:
                found = found[agent]
                age = age[agent]
            if added := self._added(agent):
                own = found if isinstance(found, Mapping) else {"observation": found}
                found = {**own, **added}
            told[agent] = found
            infos[agent] = {"age": age}
        return told, infos

    def _added(self, agent: str) -> dict[str, Numbers]:
        """The entries that are added to the observation of an agent."""
        added = {}
        parts = self._parts[agent]
        if self._timeline:
            slots = [self._slots(part) for part in parts]
            added["timeline"] = np.concatenate(slots, -1)
        if self._history:
            sent = self.actions.recent(agent)
            first = (self._default[agent], 0)
            space, low, width = self._chosen[agent]
            chosen = []
            for age in reversed(range(self._history)):
                action, _ = sent.get(age, first)
                numbers = np.asarray(flatten(space, action), np.float32)
                chosen.append((numbers - low) / width)
            added["action_history"] = np.concatenate(chosen)
        if added:
            ages = [self._observations.age[part] for part in parts]
            added["age"] = np.array(ages, np.float32)
        return added

    def _slots(self, part: str) -> Numbers:
        """The timeline of what is sent under a name, [K, D + 1]."""
        space, low, _ = self._messages[part]
        width = len(low) + 1
        slots: Any = np.zeros((self._timeline, width), np.float32)
        for age, (thing, wait) in self._observations.recent(part).items():
            if age < self._timeline and wait <= 0:
                slots[age, :-1] = flatten(space, thing)
                slots[age, -1] = 1
        return slots


class _Link:
    """The messages of some senders; a ``DelayLine`` delays their times, so that they may be
    anything.

    It keeps copies, and gives copies, because environments and agents may write over their arrays.
    """

    def __init__(self, name: str, senders: Collection[str], told: ByName) -> None:
        loss = told["loss"] if name == "observation" else 0.0
        laws: list = [told[name], loss]
        should = f"is named, but the names are: {listed(filter(None, senders))}"
        for key, given in zip((name, "loss"), laws, strict=True):
            if _by_name(given):
                unknown = [each for each in given if each not in senders]
                checks.require(not unknown, key, listed(unknown), should)
        by_name: list[ByName] = [
            law if _by_name(law) else dict.fromkeys(senders, law) for law in laws
        ]
        each = [[law.get(sender, 0) for law in by_name] for sender in senders]
        distinct = [law for i, law in enumerate(each) if law not in each[:i]]
        dt = told["dt"]
        samplers = [sampler_of(law, dt, loss, name) for law, loss in distinct]
        self.sampler: Sampler = samplers[0]
        if len(samplers) > 1:
            index = torch.tensor([distinct.index(law) for law in each])
            self.sampler = LinkSampler(samplers, index, torch.zeros(len(index)))
        self._line = DelayLine(self.sampler, "generation")
        before_step = name == "action"
        self._contexts = ContextReader(self.sampler, None, dt, name, before_step=before_step)
        names = (f"{name} {sender}".strip() for sender in senders)
        self._numbers = torch.tensor([*map(counter_rng.number_of, names)])
        self._memory: Memory | None = None
        self._now = 0
        self._kept = max(self.sampler.longest, told["timeline"], told["history"])
        self.age = dict.fromkeys(senders, 0)
        """Age of what is held of each sender [steps]."""
        self._sent: dict[str, Sent] = {sender: {} for sender in senders}
        """What was sent, and when it arrives, by sender and time."""

    def reset(self, seed: int | None) -> None:
        """Forget all messages; a seed decides all later delays."""
        self._sent = {sender: {} for sender in self.age}
        if self._memory is None or seed is not None:
            entropy = np.random.SeedSequence(seed).generate_state(1, np.uint64)
            world = torch.from_numpy(entropy.view(np.int64))
            streams = counter_rng.bits64(world, self._numbers)
            streams = streams_for(self.sampler, streams, len(streams))
            memory = self._line.init_memory([], streams)
            memory["agents"] = torch.arange(len(streams))
            self._memory = memory
            self._now = 0

    def begin(self, firsts: ByName) -> None:
        """Begin the episodes of some senders, whose ``firsts`` are known at once."""
        mask = torch.tensor([sender in firsts for sender in self.age])
        self._memory, _ = self._line.reset(cast(Memory, self._memory), [], mask)
        for sender, first in copy.deepcopy(firsts).items():
            self._sent[sender] = {self._now: (first, self._now)}
        self.age |= dict.fromkeys(firsts, 0)

    def send(self, things: ByName) -> None:
        """Send the things of some senders."""
        if self._memory is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        self._now += 1
        delays = [0] * len(self.age)
        things = copy.deepcopy(things)
        if self.sampler.late:
            sends = torch.tensor([sender in things for sender in self.age])
            sent = None if sends.all() else sends
            context = self._contexts.read(self._memory, {}, sent, sends.shape)
            self._memory, delivery = self._line.step(self._memory, [], sent, context)
            ages = delivery.age.tolist()
            self.age = dict(zip(self.age, ages, strict=True))
            delays = delivery.delay.tolist()
        now = self._now
        for sender, delay in zip(self.age, delays, strict=True):
            sent = self._sent[sender]
            if sender in things:
                due = now + delay if delay < self.sampler.lost else math.inf
                sent[now] = things[sender], due
            # What is neither recent nor held is never asked for again.
            recent = now - self._kept
            held = now - self.age[sender]
            self._sent[sender] = {t: each for t, each in sent.items() if t >= recent or t == held}

    def held(self, sender: str) -> Any:
        """What is held of a sender."""
        thing, _ = self._sent[sender][self._now - self.age[sender]]
        return copy.deepcopy(thing)

    def recent(self, sender: str) -> Sent:
        """What a sender sent lately, and the time until it arrives, by age [steps]."""
        now = self._now
        sent = self._sent[sender].items()
        return {now - time: (thing, due - now) for time, (thing, due) in sent}


def _flat(key: str, space: Space) -> tuple[Space, Numbers, Numbers]:
    """A space, and the bound and width of each of its D numbers, 0 and 1 if they have no bounds,
    [D]."""
    flat = flatten_space(space)
    if not isinstance(flat, Box):
        raise InputError(f"{key}: {space} has no vectors of a fixed length")
    with np.errstate(over="ignore"):  # a bound may be the largest number
        low = np.float32(flat.low)
        width = np.float32(flat.high) - low
    bounded = np.isfinite(width)
    low = np.where(bounded, low, np.float32(0))
    width = np.where(bounded & (width > 0), width, np.float32(1))
    return space, low, width


def _by_name(given: Any) -> bool:
    """Whether something is given by name, and is not one law for all."""
    return isinstance(given, Mapping) and "law" not in given


def _zero(space: Space) -> Any:
    """The action 0 of a space."""
    zeros = create_empty_array(space, 1)
    zero = next(iter(iterate(batch_space(space, 1), zeros)))
    if not space.contains(zero):
        raise InputError(f"default: is missing, and {space} has no action 0")
    return zero
