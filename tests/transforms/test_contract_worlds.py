"""Seeds that reach every transform, and worlds that skip steps."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import pytest
import torch
from environments import KINDS
from every_transform import (
    LATE,
    TRANSFORMS,
    drawing,
)
from helpers import all_same, same
from streams import check_independent
from torchrl.envs import Compose, EnvBase, GymEnv, ParallelEnv, SerialEnv, TransformedEnv

from damian.delays.laws import Burst, Law, Uniform
from damian.delays.samplers import ContextSampler, Sampler
from damian.transforms import (
    ActionDelay,
    ObservationDelay,
    RewardDelay,
    StatefulTransform,
    set_seed,
)

# Seeds.


@drawing
def test_set_seed_reaches_the_transforms_of_an_environment(kind, make):
    env = TransformedEnv(kind.make(), make(kind, Uniform(0, 20)))
    outputs, streams = [], []
    for number, seed in enumerate((3, 4, 3)):
        torch.manual_seed(number)  # the state of torch's generator does not matter
        set_seed(env, seed)
        outputs.append([env.reset()])
        streams.append(env.transform.memory["streams"].clone())
        torch.manual_seed(0)
        for _ in range(3):
            after, td = env.step_and_maybe_reset(env.rand_action(outputs[-1][-1].clone()))
            outputs[-1] += [after["next"], td]
    assert streams[0].equal(streams[2])
    assert not set(streams[0].tolist()) & set(streams[1].tolist())
    if kind is not KINDS["VMAS"]:  # VMAS itself goes on with its earlier random state
        assert all_same(outputs[0], outputs[2])


@pytest.mark.parametrize("wrap", [False, True], ids=["one environment", "nested environments"])
def test_all_streams_of_an_environment_differ(wrap):
    def chain() -> list[StatefulTransform]:
        return [
            ActionDelay(LATE, ("agents", "action"), seed=0),
            ObservationDelay(LATE, ("agents", "observation"), seed=0),
            ObservationDelay(LATE, "state", seed=0),
            RewardDelay(LATE, ("agents", "reward"), seed=0),
            RewardDelay(LATE, "team_reward", seed=0),
            ObservationDelay(LATE, ("agents", "observation"), age_key=None, seed=0),
        ]

    for seeded in (False, True):
        env, transforms = KINDS["flags in the group"].make(), chain()
        for transform in transforms if wrap else [Compose(*transforms)]:
            env = TransformedEnv(env, transform, auto_unwrap=False)
        if seeded:
            set_seed(env, 7919)
        env.reset()
        streams = torch.cat([transform.memory["streams"] for transform in transforms])
        assert len(streams.unique()) == len(streams) == 4 * 4 + 2 * 2
        check_independent(streams)


def pendulum(seed: int | None) -> TransformedEnv:
    delays = Compose(ObservationDelay(LATE, seed=seed), RewardDelay(LATE, seed=seed))
    return TransformedEnv(GymEnv("Pendulum-v1"), delays)


def worker_streams(env: EnvBase) -> list[int]:
    """The streams of all transforms of all workers, read from the state of a reset environment."""
    found: list[int] = []

    def walk(state: Any) -> None:
        for key, value in state.items():
            if isinstance(value, dict):
                walk(value)
            elif key.endswith("streams"):
                found.extend(value.flatten().tolist())

    env.reset()
    walk(env.state_dict())
    return found


@pytest.mark.parametrize("vector", [SerialEnv, ParallelEnv])
def test_workers_have_streams_of_their_own_that_follow_from_their_seeds(vector):
    options = {"mp_start_method": "fork"} if vector is ParallelEnv else {}
    found = []
    for seeds in ((None, None, None), (0, 1, 2), (3, 4, 5), (0, 1, 2)):
        env = vector(3, [partial(pendulum, seed) for seed in seeds], **options)
        found.append(worker_streams(env))
        env.close()
    assert len({*found[0], *found[1], *found[2]}) == 18
    check_independent(torch.tensor([*found[0], *found[1], *found[2]]))
    assert found[1] == found[3]


# Worlds that skip a step.


def two_worlds() -> EnvBase:
    """Two CartPoles, of which some may skip a step."""
    return SerialEnv(2, lambda: GymEnv("CartPole-v1", categorical_action_encoding=True))


@dataclass(frozen=True)
class ByContent(Law):
    """Delays that follow from the message, so that what a skipped step would send arrives at another time."""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        return ContextSampler(lambda c: (c.entries["seen"][:, 1] * 100).abs().floor() % 4, 3, reads=["seen"])


@pytest.mark.parametrize(
    "make",
    [
        *TRANSFORMS.values(),
        lambda kind, _: ObservationDelay(ByContent(), context_keys={"seen": "observation"}),
    ],
    ids=[*TRANSFORMS, "ObservationDelay by content"],
)
def test_a_world_that_skips_steps_goes_on_as_if_they_had_not_been(make):
    kind, law = KINDS["CartPole"], Burst(0.4, 0.4, good=Uniform(0, 2), bad=3, bad_loss=0.0)
    skipping, steady = (TransformedEnv(two_worlds(), make(kind, law)) for _ in range(2))
    for env in (skipping, steady):
        set_seed(env, 1)
        env.transform.seed_worlds(torch.tensor([5, 6]))
    td, other = skipping.reset(), steady.reset()
    actions = torch.randint(2, (8, 2), generator=torch.Generator().manual_seed(0))
    for t in range(8):
        after = steady.step(other.clone().set("action", actions[t]))["next"]
        for world in (0, 1):  # first the one, then the other; and now and then none
            mask = torch.tensor([world == 0, world == 1])
            # What the other world would have chosen must have no effect.
            chosen = torch.where(mask, actions[t], 1 - actions[t])
            stepped = skipping.step(td.clone().set("action", chosen).set("_step", mask))["next"]
            assert same(stepped[world], after[world])
            td[world] = stepped[world].select(*td.keys(True, True), strict=False)
            rest = skipping.step(td.clone().set("action", actions[t]).set("_step", torch.zeros(2).bool()))
            assert rest["next", "observation"].equal(td["observation"])
        other = other.clone().update(after.select(*other.keys(True, True), strict=False))
