"""Clocks: valid periods, the triggered system clock, and the batches between two of its ticks."""

import itertools
import math

import pytest
import torch
from helpers import square
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from damian.baselines.random import random_policy
from damian.common.errors import InputError
from damian.delays.config import DelayConfig
from damian.envs.clocks import ClockConfig
from damian.learners.schedule import SystemClock
from damian.recipes.shared.collecting import spotting, ticks
from damian.recipes.shared.settings import TrainConfig
from damian.recipes.train import learning_env
from damian.server.termination import EpisodeConfig
from damian.world.messages import Messages

SPOTTED, NOT_SPOTTED = torch.tensor([[False, True]]), torch.tensor([[False, False]])
WORLDS = 4


def triggered(period: int, trigger: str = "2s", **bounds: str) -> SystemClock:
    return SystemClock(ClockConfig(trigger=trigger, **bounds), period)


def periods(clock: SystemClock, *spotted: torch.Tensor) -> list[int]:
    """The period after each tick."""
    result = []
    for flags in spotted:
        clock.tick(flags)
        result.append(clock.period)
    return result


@pytest.mark.parametrize(("clock", "seconds"), [("1s", 1.0), ("0.5m", 30.0), ("1h", 3600.0), ("0.2", 0.2)])
def test_a_period_is_read_with_its_unit(clock, seconds):
    assert ClockConfig(simulation=clock).dt == seconds


@pytest.mark.parametrize(
    ("clock", "message"),
    [
        ({"simulation": "1s", "agents": "1.5s"}, "clock.agents: 1.5s is not a multiple"),
        ({"simulation": "2s", "server": "1s"}, "clock.server: 1s is not a multiple"),
        ({"agents": "2s", "server": "3s"}, "clock.server: 3s is not a multiple of clock.agents=2s"),
        ({"agents": "2s", "system": "9s"}, "clock.system: 9s is not a multiple of clock.agents=2s"),
        ({"system": "2s", "server": "3s"}, "clock.server: 3s is not a multiple of clock.system=2s"),
        ({"simulation": "0s"}, "clock.simulation: 0.0 s is not above 0 s"),
        ({"simulation": "fast"}, "clock.simulation: fast is not a time such as 2s"),
        ({"simulation": "nan"}, "clock.simulation: nan s is not above 0 s"),
        ({"trigger": "soon"}, "clock.trigger: soon is not a time such as 2s"),
        ({"trigger": "-2s"}, "clock.trigger: -2.0 s is not above 0 s"),
        ({"trigger": "1.5s"}, "clock.trigger: 1.5s is not a multiple of clock.simulation=1s"),
        ({"agents": "2s", "trigger": "3s"}, "clock.trigger: 3s is not a multiple of clock.agents=2s"),
        (
            {"server": "4s", "trigger": "4s", "shortest": "2s"},
            "clock.shortest: 2s is not a multiple of clock.s",
        ),
        (
            {"server": "2s", "trigger": "2s", "longest": "9s"},
            "clock.longest: 9s is not a multiple of clock.s",
        ),
        ({"shortest": "2s"}, "clock.shortest: 2s means nothing without clock.trigger"),
        ({"longest": "2s"}, "clock.longest: 2s means nothing without clock.trigger"),
    ],
)
def test_impossible_periods_are_refused(clock, message):
    with pytest.raises(InputError, match="clock") as error:
        ClockConfig(**clock)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        (
            {"shortest": "12s"},
            "clock.system: 10 steps is out of clock.shortest, clock.longest = 12, 20 steps",
        ),
        ({"longest": "8s"}, "clock.system: 10 steps is out of clock.shortest, clock.longest = 2, 8 steps"),
        ({"trigger": "11s"}, "clock.system: 10 steps is out of clock.shortest, clock.longest = 11, 20 steps"),
    ],
)
def test_a_first_period_out_of_the_bounds_is_refused(bounds, message):
    with pytest.raises(InputError) as error:
        triggered(10, **bounds)
    assert message in str(error.value)


def test_the_period_of_a_fixed_clock_never_changes():
    clock = SystemClock(ClockConfig(), 7)
    assert periods(clock, SPOTTED, NOT_SPOTTED, SPOTTED) == [7, 7, 7]
    assert (clock.unit, clock.shortest, clock.longest) == (7, 7, 7)


def test_a_triggered_clock_shrinks_while_the_source_is_spotted_and_grows_otherwise():
    assert periods(triggered(10), SPOTTED, SPOTTED, NOT_SPOTTED, NOT_SPOTTED, NOT_SPOTTED) == [
        8,
        6,
        8,
        10,
        12,
    ]


def test_a_triggered_clock_stays_within_its_bounds():
    clock = triggered(10, "4s", shortest="3s", longest="15s")
    assert periods(clock, *[SPOTTED] * 3, *[NOT_SPOTTED] * 5, SPOTTED) == [6, 3, 3, 7, 11, 15, 15, 15, 11]
    assert periods(triggered(10, "4s"), *[SPOTTED] * 3, *[NOT_SPOTTED] * 5) == [6, 4, 4, 8, 12, 16, 20, 20]


@pytest.mark.parametrize(("spotting_worlds", "period"), [(0, 12), (1, 12), (2, 8), (4, 8)])
def test_the_period_shrinks_if_the_source_is_spotted_in_half_of_the_worlds_or_more(spotting_worlds, period):
    spotted = torch.zeros(4, 3, dtype=torch.bool)
    spotted[:spotting_worlds, 1:] = True
    assert periods(triggered(10), spotted) == [period]


def test_periods_are_counted_in_simulation_steps():
    config = ClockConfig(simulation="0.5s", trigger="2s", shortest="0.1m", longest="20s", system="10s")
    clock = SystemClock(config, config.steps("system"))
    assert (clock.period, clock.change, clock.shortest, clock.longest) == (20, 4, 12, 40)


@pytest.mark.parametrize("first", [7, 10, 12])
@pytest.mark.parametrize("bounds", [{}, {"shortest": "6s", "longest": "15s"}, {"shortest": "1s"}])
def test_every_period_that_can_occur_is_a_multiple_of_the_unit(first, bounds):
    clock, reached, unexplored = triggered(first, "3s", **bounds), {first}, [first]
    unit = clock.unit
    while unexplored:
        clock.period = unexplored.pop()
        start = clock.state_dict()
        for flags in (SPOTTED, NOT_SPOTTED):
            clock.load_state_dict(start)
            unexplored += {*periods(clock, flags)} - reached
            reached.add(clock.period)
    assert len(reached) > 2
    assert unit == math.gcd(*reached, clock.shortest, clock.longest)


def test_a_clock_continues_from_a_checkpoint():
    one, other = triggered(10), triggered(10)
    periods(one, SPOTTED, SPOTTED)
    other.load_state_dict(one.state_dict())
    assert periods(other, NOT_SPOTTED) == periods(one, NOT_SPOTTED) == [8]


# Batches that the training recipe collects between two ticks.


def config(clock: ClockConfig, level_db: float) -> TrainConfig:
    scenario = square(episode=EpisodeConfig(max_steps=7), delay=DelayConfig(obs=2))
    scenario.source.level_db = level_db
    sections = {name: getattr(scenario, name) for name in ("region", "source", "episode", "delay")}
    return TrainConfig(**sections, clock=clock, worlds=WORLDS, backupdate=True)


def batches(config: TrainConfig, n_steps: int, period: int) -> list[tuple[int, TensorDictBase]]:
    """Batches of ``n_steps`` steps or more in all, each with the system clock's period at that time."""
    env, clock = learning_env(config), SystemClock(config.clock, period)
    frames = WORLDS * clock.unit
    collector = Collector(env, random_policy(env), frames_per_batch=frames, total_frames=-1)
    torch.manual_seed(3)
    collected, current = [], clock.period
    for batch in ticks(collector, clock, env.server):
        collected.append((current, batch))
        current = clock.period
        if sum(batch.shape[1] for _, batch in collected) >= n_steps:
            break
    collector.shutdown()
    return collected


CLOCKS = {"fixed": ClockConfig(), "triggered": ClockConfig(trigger="3s", shortest="2s", longest="12s")}


@pytest.mark.parametrize("kind", CLOCKS)
def test_a_batch_has_one_period_of_steps_and_no_step_is_lost_or_doubled(kind):
    setting = config(CLOCKS[kind], level_db=138.0)
    collected, server = batches(setting, 80, 5), learning_env(setting).server
    assert [batch.shape for _, batch in collected] == [(WORLDS, period) for period, _ in collected]
    changes = {b - a for (a, _), (b, _) in itertools.pairwise(collected)}
    assert (changes == {0}) if kind == "fixed" else (min(changes) < 0 < max(changes))
    for (period, batch), (next_period, _) in itertools.pairwise(collected):
        spots = Messages.unpack(batch["next", "agents", "received"][:, -1]).spotted.any(-1)
        assert spots.equal(spotting(batch, server).any(-1))
        expected = SystemClock(setting.clock, 5)
        expected.period = period
        expected.tick(spots.unsqueeze(-1))
        assert next_period == expected.period
    batched = torch.cat([batch for _, batch in collected], 1)
    torch.manual_seed(3)
    env = learning_env(setting)
    rollout = env.rollout(batched.shape[1], random_policy(env), break_when_any_done=False)
    assert rollout["next", "done"].any()
    for key in rollout.keys(True, True):
        assert batched[key].equal(rollout[key]), key


def test_without_delay_the_trigger_depends_on_what_the_uavs_spot_now():
    loud = config(CLOCKS["triggered"], level_db=170.0)
    quiet = config(CLOCKS["triggered"], level_db=100.0)
    for setting in (loud, quiet):
        setting.delay, setting.backupdate = DelayConfig(), False
    assert [period for period, _ in batches(loud, 10, 5)] == [5, 2, 2, 2]
    assert [period for period, _ in batches(quiet, 30, 5)] == [5, 8, 11, 12]
