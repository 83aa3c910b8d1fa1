"""Back-updating in any environment, against a loop over a world's steps, and what a storage
refuses.

``Remote`` has no UAVs; its receiver gets messages late, at the root or in a group of agents.
"""

import random
from typing import NamedTuple

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, ReplayBuffer, Unbounded
from torchrl.envs import (
    Compose,
    EnvBase,
    MultiStepTransform,
    StepCounter,
    Transform,
    TransformedEnv,
)

from damian import (
    ActionDelay,
    CumulativeReward,
    ObservationDelay,
    RewardDelay,
    SampleAndHold,
    Uniform,
)
from damian.common.errors import InputError
from damian.keys import next_key
from damian.replay.backupdate import BackupdateStorage, corrections_of

LONGEST = 5
WORLDS = 3
AGENTS = 2
LIMIT = 12
GAMMA = 0.7
GROUPS = [(), ("agents",)]
ENDS = ("done", "terminated", "truncated")
both_layouts = pytest.mark.parametrize("group", GROUPS, ids=["root", "group"])


def key(group, name):
    return (*group, name) if group else name


def outcome(group, message, elapsed):
    """What a receiver concludes from messages [*, 2] or [*, N, 2] after ``elapsed`` [*, 1]
    steps."""
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
    """Each message is the sender's random number of the step, behind one that no other message
    has."""

    def __init__(self, group):
        super().__init__(batch_size=[WORLDS])
        self.group = group
        self.shape_of_rows = (WORLDS, *[AGENTS] * bool(group))
        self.n_sent = 0
        self.elapsed = torch.zeros(WORLDS, 1, dtype=torch.long)

        def spec(width):
            return Unbounded((*self.shape_of_rows, width))

        entries = {"message": spec(2), "observation": spec(3)}
        self.observation_spec = self._nested(entries)
        self.observation_spec["world"] = Unbounded((WORLDS,))
        self.reward_spec = self._nested({"reward": spec(1)})
        self.action_spec = Bounded(0.0, 1.0, (WORLDS, 1))
        flag = Unbounded((WORLDS, 1), dtype=torch.bool)
        self.done_spec = Composite({name: flag.clone() for name in ENDS}, shape=[WORLDS])

    def _nested(self, entries):
        inner = Composite(entries, shape=self.shape_of_rows)
        return Composite({self.group[0]: inner}, shape=[WORLDS]) if self.group else inner

    def _outputs(self, *left_out):
        self.n_sent += 1
        n_rows = torch.Size(self.shape_of_rows).numel()
        number = (100.0 * self.n_sent + torch.arange(n_rows)).view(self.shape_of_rows)
        message = torch.stack([number, torch.rand(self.shape_of_rows)], -1)
        entries = {
            key(self.group, "message"): message,
            "world": torch.arange(WORLDS).float(),
        }
        entries |= outcome(self.group, message, self.elapsed)
        agents = {"agents": TensorDict({}, self.shape_of_rows)} if self.group else {}
        outputs = TensorDict(agents, [WORLDS])
        for name, value in entries.items():
            if name not in left_out:
                outputs[name] = value
        return outputs

    def _reset(self, tensordict=None, **_):
        self.elapsed = (
            self.elapsed * 0 if tensordict is None else self.elapsed * ~tensordict["_reset"]
        )
        return self._outputs(key(self.group, "reward"), *ENDS)

    def _step(self, tensordict):
        self.elapsed = self.elapsed + 1
        return self._outputs()

    def _set_seed(self, seed):
        torch.manual_seed(seed or 0)


class Receiver(Transform):
    """Replaces the outputs by those that follow from the messages received."""

    def __init__(self, group):
        super().__init__()
        self.group = group

    def _step(self, tensordict, next_tensordict):
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


def make_env(group, case=Case()):  # noqa: B008 (never changed)
    """The environment with late messages and what a case says."""
    message, received, reward = (key(group, name) for name in ("message", "received", "reward"))
    told = {
        "loss": case.loss,
        "order": case.order,
        "delay_key": "delay",
        "seed": 3,
    }
    transforms = [ObservationDelay(Uniform(0, LONGEST), [message], [received], **told)]
    transforms += [StepCounter(), Receiver(group)]
    if case.latest is not None:
        transforms.append(
            RewardDelay(Uniform(0, case.latest), reward, delay_key="reward_delay", seed=4)
        )
    if case.window > 1:
        transforms.append(CumulativeReward(case.window, GAMMA, reward))
    if case.period > 1:
        transforms.append(SampleAndHold(case.period, [key(group, "observation")]))
    return TransformedEnv(Remote(group), Compose(*transforms))


def rollout(env, n_steps):
    torch.manual_seed(1)
    return env.rollout(n_steps, break_when_any_done=False)


def recompute_of(
    group,
):
    def recompute(steps, messages):
        entries = outcome(group, messages, steps["next", "step_count"])
        return {next_key(name): value for name, value in entries.items()}

    return recompute


def make_storage(group, recompute=None, **options):
    names = {f"{name}_key": key(group, name) for name in ("message", "received", "delay", "age")}
    recompute = recompute or recompute_of(group)
    return BackupdateStorage(80 * WORLDS, recompute, LONGEST, **{**names, **options})


def stored(storage, steps, parts=1):
    """Write steps [B, T] in several parts; returns them as stored, [T, B]."""
    buffer = ReplayBuffer(storage=storage)
    for part in steps.split(steps.shape[1] // parts, 1):
        buffer.extend(part)
    return storage[storage.latest()]


class Twin:
    """What a receiver knows of the stored steps [T, B] of one world after the last of them, step by
    step."""

    def __init__(self, steps, world, group, case):
        self.steps = steps[:, world]
        self.group = group
        self.T = len(steps)
        self.case = case
        self.senders = [(i,) for i in range(AGENTS)] if group else [()]
        self.start = [t - int(self.steps["step_count"][t]) for t in range(self.T)]
        self.newest = [[self._newest(t, row) for row in self.senders] for t in range(self.T)]
        self.terminated = []
        self.truncated = []
        self.valid = []
        over = False
        for t in range(self.T):
            over = over and t != self.start[t]
            self.valid.append(not over)
            elapsed = t - self.start[t] + 1
            terminated = any(self.message(t, row)[1] < 0.1 for row in self.senders)
            reset = bool(self.steps["next", "done"][t])
            self.terminated.append(terminated)
            self.truncated.append((elapsed >= LIMIT or reset) and not terminated)
            over = over or terminated or elapsed >= LIMIT or reset

    def _newest(self, t, row):
        """The step after which the newest message was sent; the step before the episode, if at its
        reset."""
        delay = self.steps[next_key(key(self.group, "delay"))]
        arrived = [
            g for g in range(self.start[t], t + 1) if 0 <= delay[(g, *row)] <= self.T - 1 - g
        ]
        return max(arrived, default=self.start[t] - 1)

    def message(self, t, row):
        g = self.newest[t][self.senders.index(row)]
        name = key(self.group, "message")
        at_reset = g < self.start[t]
        found = (
            self.steps[name][(g + 1, *row)] if at_reset else self.steps[next_key(name)][(g, *row)]
        )
        return found.tolist()

    def observation(self, t, row):
        number, draw = self.message(t, row)
        return [3 * number, 3 * draw, number]

    def reward(self, t, row):
        return self.message(t, row)[1] + t - self.start[t] + 1

    def paid(self, t, row):
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

    def summed(self, t, row):
        """The reward after the step: eq. 4 of the rewards that have been received."""
        latest = range(max(self.start[t], t - self.case.window + 1), t + 1)
        return sum(GAMMA ** (t - g) * self.reward(g, row) for g in latest if self.paid(g, row))

    def held(self, t, row):
        """The observation after the step: that of the latest tick, or of the reset."""
        tick = t - (t - self.start[t] + 1) % self.case.period
        if tick < self.start[t]:
            return self.steps[key(self.group, "observation")][(self.start[t], *row)].tolist()
        return self.observation(tick, row)

    def held_before(self, t, row):
        if t == self.start[t]:
            return self.steps[key(self.group, "observation")][(t, *row)].tolist()
        return self.held(t - 1, row)


def random_case(rng):
    latest = rng.choice([None, 0, 2, LONGEST])
    window = rng.randint(1, 4)
    period = rng.randint(1, 5)
    return Case(
        latest, window, period, rng.choice([0.0, 0.4]), rng.choice(["generation", "arrival"])
    )


def storage_of(env, group, n_steps):
    """A storage of ``n_steps`` steps, with the corrections that follow from the environment."""
    recomputed = [key(group, name) for name in ("observation", "reward")]
    corrections = corrections_of(env.transform, recomputed)
    hindsight = key(group, "hindsight")
    storage = make_storage(group, corrections=corrections, hindsight_key=hindsight)
    storage.max_size = n_steps * WORLDS
    return storage


@pytest.mark.sample(2)
@both_layouts
@pytest.mark.parametrize("seed", range(4))
def test_stored_steps_become_what_a_slow_twin_says(group, seed):
    rng = random.Random(seed)
    for _ in range(3):
        case = random_case(rng)
        part = rng.choice([4, 10, 20])
        env = make_env(group, case)
        collected = rollout(env, 40)
        capacity = (
            part + 2 * LONGEST + case.window - 1 + case.period - 1
        )  # the least, so that the ring wraps
        after = stored(storage_of(env, group, min(capacity, 40)), collected, 40 // part)
        steps = collected.transpose(0, 1)
        n_older = 40 - len(after)
        for name in ("message", "received", "delay", "age"):  # what was known at the time stays
            known = next_key(key(group, name))
            assert after[known].equal(steps[known][n_older:])
        for world in range(WORLDS):
            twin = Twin(steps, world, group, case)
            done = [a or b for a, b in zip(twin.terminated, twin.truncated, strict=True)]
            ends = {"terminated": twin.terminated, "truncated": twin.truncated, "done": done}
            for name, right in ends.items():
                assert after["next", name][:, world, 0].tolist() == right[n_older:]
            assert after["valid"][:, world, 0].tolist() == twin.valid[n_older:]
            for t in range(n_older, 40):
                for row in twin.senders:
                    check_step(after, (t - n_older, world, *row), twin, t, row)
    assert n_older >= 0


def check_step(after, at, twin, t, row):
    """Compare what is stored of a step with the twin."""
    observation = key(twin.group, "observation")
    reward = key(twin.group, "reward")
    assert after[next_key(key(twin.group, "hindsight"))][at].tolist() == twin.message(t, row)
    assert after[next_key(reward)][at].item() == pytest.approx(twin.summed(t, row)), (twin.case, t)
    assert after[next_key(observation)][at].tolist() == pytest.approx(twin.held(t, row)), (
        twin.case,
        t,
    )
    assert after[observation][at].tolist() == pytest.approx(twin.held_before(t, row)), (
        twin.case,
        t,
    )


@both_layouts
@pytest.mark.parametrize("order", ["generation", "arrival"])
def test_backupdated_counts_the_rewards_that_late_messages_have_changed_and_not_the_messages(
    group, order
):
    reward, received = (next_key(key(group, name)) for name in ("reward", "received"))

    def recompute(_, messages):
        return {reward: (messages[..., 1:] > 0.3).float()}

    collected = rollout(make_env(group, Case(order=order)), 60)
    collected[reward] = recompute(collected, collected[received])[reward]
    storage = make_storage(group, recompute, hindsight_key=key(group, "hindsight"))
    buffer = ReplayBuffer(storage=storage)
    known = collected[reward].transpose(0, 1).clone()
    changed = torch.zeros_like(known, dtype=torch.bool)
    for end in range(5, 65, 5):
        buffer.extend(collected[:, end - 5 : end])
        now = storage[storage.latest()]
        changed[:end] |= now[reward] != known[:end]
        known[:end] = now[reward]
    for name in ENDS:  # recompute says nothing of them
        assert now["next", name].equal(collected["next", name].transpose(0, 1))
    assert now["valid"].all()
    assert now[key(group, "backupdated")].equal(changed)
    replaced = (now[next_key(key(group, "hindsight"))] != now[received]).any(-1)
    assert 0 < changed.float().mean() < 0.8 * replaced.float().mean()


# Mistakes.

NAMES = {f"{name}_key": name for name in ("message", "received", "delay", "age")}
LEAST = (8 + 2 * LONGEST) * WORLDS
"""The least size of a storage of batches of 8 steps."""


def recomputing(change):
    """A storage whose ``recompute`` returns something else."""
    return make_storage((), lambda *arguments: change(recompute_of(())(*arguments)))


def extend_twice(first, second):
    storage = make_storage(())
    stored(storage, first)
    stored(storage, second)


def extend_joined(steps):
    n_step = MultiStepTransform(n_steps=3, gamma=0.9)
    ReplayBuffer(
        storage=make_storage(()),
        transform=n_step,
        batch_size=4,
    ).extend(steps)


REFUSED = {
    r"message_key: \('next', 'none'\) is not in the steps": lambda steps: stored(
        make_storage((), message_key="none"), steps
    ),
    "recompute: .*is not an entry after the steps": lambda steps: stored(
        recomputing(lambda entries: entries | {("next", "success"): entries["next", "reward"]}),
        steps,
    ),
    "step_count grows from world to world": lambda steps: stored(
        make_storage(()), steps.transpose(0, 1)
    ),
    r"steps: a batch of shape \[.*\] is not one of 3 worlds": lambda steps: extend_twice(
        steps, steps[:2]
    ),
    "MultiStepTransform joins steps before they are corrected": extend_joined,
    f"of {WORLDS} worlds need {LEAST}": lambda steps: stored(
        BackupdateStorage(LEAST - 1, recompute_of(()), LONGEST, **NAMES), steps
    ),
    "RewardDelay: back-updating needs each delay": lambda _: corrections_of(
        Compose(ActionDelay(2), RewardDelay(2)), ["reward"]
    ),
}


@pytest.mark.parametrize("line", REFUSED)
def test_a_mistake_is_one_line(line):
    steps = rollout(make_env(()), 8)
    stored(
        BackupdateStorage(LEAST, recompute_of(()), LONGEST, **NAMES), steps
    )  # which is large enough
    with pytest.raises(InputError, match=line):
        REFUSED[line](steps)
