"""An environment without UAVs, whose receiver gets messages late, at the root or in a group of agents; and a
slow twin of back-updating."""

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, ReplayBuffer, Unbounded
from torchrl.envs import Compose, EnvBase, StepCounter, Transform, TransformedEnv

from damian.delays.laws import Uniform
from damian.keys import next_key
from damian.replay.backupdate import BackupdateStorage
from damian.transforms import CumulativeReward, ObservationDelay, RewardDelay, SampleAndHold

LONGEST, WORLDS, AGENTS, LIMIT = 5, 3, 2, 12
GAMMA = 0.7
GROUPS = [(), ("agents",)]
ENDS = ("done", "terminated", "truncated")
both_layouts = pytest.mark.parametrize("group", GROUPS, ids=["root", "group"])


def key(group: tuple[str, ...], name: str) -> NestedKey:
    return (*group, name) if group else name


def outcome(group: tuple[str, ...], message: Tensor, elapsed: Tensor) -> dict[NestedKey, Tensor]:
    """What a receiver concludes from messages [*, 2] or [*, N, 2] after ``elapsed`` [*, 1] steps."""
    alarm = message[..., 1] < 0.1
    terminated = alarm.any(-1, keepdim=True) if group else alarm.unsqueeze(-1)
    truncated = (elapsed >= LIMIT) & ~terminated
    steps = elapsed.unsqueeze(-1) if group else elapsed
    return {
        key(group, "observation"): torch.cat([3 * message, message[..., :1]], -1),
        key(group, "reward"): message[..., 1:] + steps,
        **dict(zip(ENDS, (terminated | truncated, terminated, truncated), strict=True)),
    }


class Remote(EnvBase):
    """Each message is the sender's random number of the step, behind one that no other message has."""

    def __init__(self, group: tuple[str, ...]) -> None:
        super().__init__(batch_size=[WORLDS])
        self.group, self.shape_of_rows = group, (WORLDS, *[AGENTS] * bool(group))
        self.n_sent, self.elapsed = 0, torch.zeros(WORLDS, 1, dtype=torch.long)

        def spec(width: int) -> Composite | Unbounded:
            return Unbounded((*self.shape_of_rows, width))

        entries = {"message": spec(2), "observation": spec(3)}
        self.observation_spec = self._nested(entries)
        self.observation_spec["world"] = Unbounded((WORLDS,))
        self.reward_spec = self._nested({"reward": spec(1)})
        self.action_spec = Bounded(0.0, 1.0, (WORLDS, 1))
        flag = Unbounded((WORLDS, 1), dtype=torch.bool)
        self.done_spec = Composite({name: flag.clone() for name in ENDS}, shape=[WORLDS])

    def _nested(self, entries: dict[str, Any]) -> Composite:
        inner = Composite(entries, shape=self.shape_of_rows)
        return Composite({self.group[0]: inner}, shape=[WORLDS]) if self.group else inner

    def _outputs(self, *left_out: str) -> TensorDict:
        self.n_sent += 1
        n_rows = torch.Size(self.shape_of_rows).numel()
        number = (100.0 * self.n_sent + torch.arange(n_rows)).view(self.shape_of_rows)
        message = torch.stack([number, torch.rand(self.shape_of_rows)], -1)
        entries = {key(self.group, "message"): message, "world": torch.arange(WORLDS).float()}
        entries |= outcome(self.group, message, self.elapsed)
        agents = {"agents": TensorDict({}, self.shape_of_rows)} if self.group else {}
        outputs = TensorDict(agents, [WORLDS])
        for name, value in entries.items():
            if name not in left_out:
                outputs[name] = value
        return outputs

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        self.elapsed = self.elapsed * 0 if tensordict is None else self.elapsed * ~tensordict["_reset"]
        return self._outputs(key(self.group, "reward"), *ENDS)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.elapsed = self.elapsed + 1
        return self._outputs()

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(seed or 0)


class Receiver(Transform):
    """Replaces the outputs by those that follow from the messages received."""

    def __init__(self, group: tuple[str, ...]) -> None:
        super().__init__()
        self.group = group

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        held = next_tensordict[key(self.group, "received")]
        for name, value in outcome(self.group, held, next_tensordict["step_count"]).items():
            next_tensordict[name] = value
        return next_tensordict


class Case(NamedTuple):
    """How late rewards are, how many are summed, and how slow the receiver's clock is."""

    latest: int | None = None
    window: int = 1
    period: int = 1
    loss: float = 0.1
    order: str = "generation"


def make_env(group: tuple[str, ...], case: Case = Case()) -> TransformedEnv:  # noqa: B008 (never changed)
    """The environment with late messages and what a case says."""
    message, received, reward = (key(group, name) for name in ("message", "received", "reward"))
    told = {"loss": case.loss, "order": case.order, "delay_key": "delay", "seed": 3}
    transforms = [ObservationDelay(Uniform(0, LONGEST), [message], [received], **told)]
    transforms += [StepCounter(), Receiver(group)]
    if case.latest is not None:
        transforms.append(RewardDelay(Uniform(0, case.latest), reward, delay_key="reward_delay", seed=4))
    if case.window > 1:
        transforms.append(CumulativeReward(case.window, GAMMA, reward))
    if case.period > 1:
        transforms.append(SampleAndHold(case.period, [key(group, "observation")]))
    return TransformedEnv(Remote(group), Compose(*transforms))


def rollout(env: TransformedEnv, n_steps: int) -> TensorDictBase:
    torch.manual_seed(1)
    return env.rollout(n_steps, break_when_any_done=False)


def recompute_of(group: tuple[str, ...]) -> Callable[[TensorDictBase, Tensor], dict[NestedKey, Tensor]]:
    def recompute(steps: TensorDictBase, messages: Tensor) -> dict[NestedKey, Tensor]:
        entries = outcome(group, messages, steps["next", "step_count"])
        return {next_key(name): value for name, value in entries.items()}

    return recompute


def make_storage(group: tuple[str, ...], recompute: Any = None, **options: Any) -> BackupdateStorage:
    names = {f"{name}_key": key(group, name) for name in ("message", "received", "delay", "age")}
    recompute = recompute or recompute_of(group)
    return BackupdateStorage(80 * WORLDS, recompute, LONGEST, **{**names, **options})


def stored(storage: BackupdateStorage, steps: TensorDictBase, parts: int = 1) -> TensorDictBase:
    """Write steps [B, T] in several parts; returns them as stored, [T, B]."""
    buffer = ReplayBuffer(storage=storage)
    for part in steps.split(steps.shape[1] // parts, 1):
        buffer.extend(part)
    return storage[storage.latest()]


class Twin:
    """What a receiver knows of the stored steps [T, B] of one world after the last of them, step by step."""

    def __init__(self, steps: TensorDictBase, world: int, group: tuple[str, ...], case: Case) -> None:
        self.steps, self.group, self.T, self.case = steps[:, world], group, len(steps), case
        self.senders = [(i,) for i in range(AGENTS)] if group else [()]
        self.start = [t - int(self.steps["step_count"][t]) for t in range(self.T)]
        self.newest = [[self._newest(t, row) for row in self.senders] for t in range(self.T)]
        self.terminated, self.truncated, self.valid, over = [], [], [], False
        for t in range(self.T):
            over = over and t != self.start[t]
            self.valid.append(not over)
            elapsed = t - self.start[t] + 1
            terminated = any(self.message(t, row)[1] < 0.1 for row in self.senders)
            reset = bool(self.steps["next", "done"][t])
            self.terminated.append(terminated)
            self.truncated.append((elapsed >= LIMIT or reset) and not terminated)
            over = over or terminated or elapsed >= LIMIT or reset

    def _newest(self, t: int, row: tuple[int, ...]) -> int:
        """The step after which the newest message was sent; the step before the episode, if at its reset."""
        delay = self.steps[next_key(key(self.group, "delay"))]
        arrived = [g for g in range(self.start[t], t + 1) if 0 <= delay[(g, *row)] <= self.T - 1 - g]
        return max(arrived, default=self.start[t] - 1)

    def message(self, t: int, row: tuple[int, ...]) -> list[float]:
        g, name = self.newest[t][self.senders.index(row)], key(self.group, "message")
        at_reset = g < self.start[t]
        return (
            self.steps[name][(g + 1, *row)] if at_reset else self.steps[next_key(name)][(g, *row)]
        ).tolist()

    def observation(self, t: int, row: tuple[int, ...]) -> list[float]:
        number, draw = self.message(t, row)
        return [3 * number, 3 * draw, number]

    def reward(self, t: int, row: tuple[int, ...]) -> float:
        return self.message(t, row)[1] + t - self.start[t] + 1

    def paid(self, t: int, row: tuple[int, ...]) -> bool:
        """Has the reward that step t earned been received by the last step."""
        if self.case.latest is None:
            return True
        delay = int(self.steps[next_key(key(self.group, "reward_delay"))][(t, *row)])
        for later in range(t, self.T):
            if self.start[later] != self.start[t]:
                return False
            if later - t >= delay or self.steps["next", "done"][later]:
                return True
        return False

    def summed(self, t: int, row: tuple[int, ...]) -> float:
        """The reward after the step: eq. 4 of the rewards that have been received."""
        latest = range(max(self.start[t], t - self.case.window + 1), t + 1)
        return sum(GAMMA ** (t - g) * self.reward(g, row) for g in latest if self.paid(g, row))

    def held(self, t: int, row: tuple[int, ...]) -> list[float]:
        """The observation after the step: that of the latest tick, or of the reset."""
        tick = t - (t - self.start[t] + 1) % self.case.period
        if tick < self.start[t]:
            return self.steps[key(self.group, "observation")][(self.start[t], *row)].tolist()
        return self.observation(tick, row)

    def held_before(self, t: int, row: tuple[int, ...]) -> list[float]:
        if t == self.start[t]:
            return self.steps[key(self.group, "observation")][(t, *row)].tolist()
        return self.held(t - 1, row)
