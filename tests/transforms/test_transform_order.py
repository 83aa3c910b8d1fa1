"""Orders of transforms in which one would undo or miss the work of another are refused."""

import pytest
from contract import (
    LATE,
    OBSERVATION,
    REWARD,
    Drift,
    unserved,
)
from plain_env import Plain
from torchrl.envs import (
    CatFrames,
    Compose,
    ConditionalSkip,
    FrameSkipTransform,
    GymEnv,
    InitTracker,
    NoopResetEnv,
    RandomTruncationTransform,
    RewardSum,
    SerialEnv,
    StepCounter,
    TerminateTransform,
    Transform,
    TransformedEnv,
)

from damian.common.errors import InputError
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    CumulativeReward,
    ObservationDelay,
    RewardDelay,
    SampleAndHold,
    ServerNode,
)

# The order of transforms.


def delay(**options):
    return ObservationDelay(LATE, **options)


WRONG = {
    "a history before an action delay": (lambda: ActionHistory(2), lambda: ActionDelay(LATE)),
    "a history before a clock that holds actions": (
        lambda: ActionHistory(2),
        lambda: SampleAndHold(2, in_keys_inv=["action"]),
    ),
    "an observation delay after a history that appends": (
        lambda: ActionHistory(2, append_to="observation"),
        delay,
    ),
    "a clock after a history that appends": (
        lambda: ActionHistory(2, append_to="observation"),
        lambda: SampleAndHold(2),
    ),
}
RIGHT = {
    "a history after an action delay": (lambda: ActionDelay(LATE), lambda: ActionHistory(2)),
    "a history that appends after an observation delay": (
        delay,
        lambda: ActionHistory(2, append_to="observation"),
    ),
    "a history that appends after a clock": (
        lambda: SampleAndHold(2, in_keys_inv=["action"]),
        lambda: ActionHistory(2, append_to="observation"),
    ),
    "a clock after a history with its own entry": (lambda: ActionHistory(2), lambda: SampleAndHold(2)),
    "sums of delayed rewards": (lambda: RewardDelay(LATE), lambda: CumulativeReward(3)),
    "two delays of one observation": (delay, lambda: ObservationDelay(1, age_key=None)),
}


def appended_inside(env, one, other):
    inner = Compose(InitTracker())
    env = TransformedEnv(env, Compose(one, inner))
    inner.append(other)
    return env


WAYS = {
    "Compose": lambda env, one, other: TransformedEnv(env, Compose(one, other)),
    "append inside": appended_inside,
    "around a transformed environment": lambda env, one, other: TransformedEnv(
        TransformedEnv(env, one), other
    ),
}
every_way = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)


@every_way
@pytest.mark.parametrize("pair", WRONG.values(), ids=WRONG)
def test_a_wrong_order_of_transforms_is_refused_however_they_are_composed(pair, way):
    one, other = (make() for make in pair)
    names = f"{type(one).__name__} must come after {type(other).__name__}"
    with pytest.raises(InputError, match=names):
        way(Drift(), one, other).reset()


@every_way
@pytest.mark.parametrize("pair", RIGHT.values(), ids=RIGHT)
def test_a_right_order_of_transforms_works(pair, way):
    env = way(Drift(), *(make() for make in pair))
    assert env.rollout(6, break_when_any_done=False).shape == (3, 6)


MESSAGE, RECEIVED = ("agents", "message"), ("agents", "received")


def uplink():
    return ObservationDelay(LATE, [MESSAGE], [RECEIVED])


def server():
    return ServerNode(unserved().server)


@pytest.mark.parametrize(
    "other", [uplink, lambda: RewardDelay(2, REWARD), lambda: SampleAndHold(2, [OBSERVATION])]
)
def test_a_server_node_must_come_after_the_uplink_and_before_transforms_of_its_outputs(other):
    chain = [uplink, server, other] if other is not uplink else [uplink, server]
    env = TransformedEnv(unserved(), Compose(*(make() for make in chain)))
    assert env.rollout(4).shape == (2, 4)
    wrong = [server, uplink] if other is uplink else [uplink, other, server]
    with pytest.raises(InputError, match=r"order of transforms|is not among the keys"):
        TransformedEnv(unserved(), Compose(*(make() for make in wrong))).reset()


# TorchRL's own transforms.


FOREIGN_WRONG = {
    "a time limit": lambda: StepCounter(max_steps=5),
    "random time limits": lambda: RandomTruncationTransform(1, 5),
    "a condition for the end": lambda: TerminateTransform(lambda td: td["done"]),
}


@every_way
@pytest.mark.parametrize("ends", FOREIGN_WRONG.values(), ids=FOREIGN_WRONG)
def test_a_reward_delay_must_come_after_what_ends_episodes(ends, way):
    transform = ends()
    counter = [StepCounter()] if isinstance(transform, RandomTruncationTransform) else []
    with pytest.raises(InputError, match=rf"RewardDelay must come after {type(transform).__name__}.*be lost"):
        way(TransformedEnv(Drift(), Compose(*counter)), RewardDelay(2), transform).reset()


def test_the_order_is_checked_across_nested_environments():
    inner = TransformedEnv(Drift(), ActionHistory(2))
    with pytest.raises(InputError, match="ActionHistory must come after ActionDelay"):
        TransformedEnv(inner, ActionDelay(2), auto_unwrap=False).reset()


def test_what_skips_steps_must_come_last():
    def skip() -> ConditionalSkip:
        return ConditionalSkip(lambda td: td["done"])

    assert TransformedEnv(Drift(), Compose(delay(), skip())).reset().shape == (3,)
    with pytest.raises(InputError, match="ConditionalSkip must come after ObservationDelay"):
        Compose(skip(), delay())


@pytest.mark.parametrize(
    ("early", "late"),
    [
        (RewardSum, lambda: RewardDelay(2)),
        (lambda: CatFrames(2, -1, ["observation"], ["frames"]), lambda: SampleAndHold(2)),
    ],
)
def test_a_warning_says_what_follows_from_an_entry_before_it_is_delayed(early, late):
    with pytest.warns(UserWarning, match="computes .* from .* before .* changes"):
        Compose(early(), late())
    Compose(late(), early())


@every_way
@pytest.mark.parametrize("keys", [{}, {"in_keys": ["observation", "age"]}])
def test_a_warning_says_that_the_age_of_what_is_held_does_not_grow(way, keys):
    problem = "SampleAndHold holds observation, whose age ObservationDelay writes under age: give SampleAnd"
    with pytest.warns(UserWarning, match=problem):
        way(Drift(), delay(), SampleAndHold(2, **keys)).reset()


@every_way
@pytest.mark.parametrize(
    ("options", "clock"),
    [
        ({}, lambda: SampleAndHold(2, age_key="age")),
        ({}, lambda: SampleAndHold(2, in_keys=[], in_keys_inv=["action"])),
        ({"age_key": None}, lambda: SampleAndHold(2)),
        ({"out_keys": ["late"]}, lambda: SampleAndHold(2)),
    ],
)
def test_a_clock_that_keeps_no_age_wrong_gives_no_warning(way, options, clock):
    way(Drift(), delay(**options), clock()).reset()


def test_an_end_around_the_workers_loses_the_rewards_of_a_delay_within_them():
    """What docs/transforms.md says, and the two remedies that it names."""

    def paid(inner: list[Transform], outer: list[Transform]) -> list[float]:
        workers = SerialEnv(2, lambda: TransformedEnv(Plain(), Compose(*copies(inner))))
        env = TransformedEnv(workers, Compose(*outer))
        steps = env.rollout(8, break_when_any_done=False)  # two episodes of 4 steps, which earn 1, 2, 3 and 4
        return steps["next", "agents", "reward"][0, 0, :, 0, 0].tolist()

    def copies(transforms: list[Transform]) -> list[Transform]:
        return [transform.clone() for transform in transforms]

    key = ("agents", "reward")
    assert paid([RewardDelay(2, key)], [StepCounter(4)]) == [0, 0, 1, 2] * 2
    assert paid([StepCounter(4), RewardDelay(2, key)], []) == [0, 0, 1, 2 + 3 + 4] * 2
    assert paid([], [StepCounter(4), RewardDelay(2, key)]) == [0, 0, 1, 2 + 3 + 4] * 2


@pytest.mark.parametrize("stepping", [lambda: FrameSkipTransform(2), lambda: NoopResetEnv(2)])
def test_what_steps_a_copy_of_the_environment_must_come_first_or_around(stepping):
    with pytest.raises(InputError, match=f"ObservationDelay must come after {type(stepping()).__name__}"):
        TransformedEnv(GymEnv("Pendulum-v1"), Compose(ObservationDelay(2), stepping())).reset()


def test_a_frame_skip_before_or_around_a_delay_works():
    delayed, skip = TransformedEnv(GymEnv("Pendulum-v1"), ObservationDelay(3)), FrameSkipTransform(2)
    around = TransformedEnv(delayed, skip, auto_unwrap=False)
    before = TransformedEnv(GymEnv("Pendulum-v1"), Compose(FrameSkipTransform(2), ObservationDelay(3)))
    ages = [env.rollout(4)["next", "age"].flatten().tolist() for env in (around, before)]
    assert ages == [[2, 3, 3, 3], [1, 2, 3, 3]]
