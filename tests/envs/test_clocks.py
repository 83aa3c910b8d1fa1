"""Clocks: their periods, which of them fit, and the batches between two ticks of the learner's."""

import itertools
import math

import pytest
import torch
from helpers import square
from shared.settings import TrainConfig
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from train import learning_env, spotting, ticks

from damian.baselines.random import random_policy
from damian.common.errors import InputError
from damian.delays.config import DelayConfig
from damian.envs.clocks import ClockConfig
from damian.learners.schedule import SystemClock
from damian.server.termination import EpisodeConfig
from damian.world.messages import Messages

SPOTTED, QUIET = torch.tensor([[False, True]]), torch.tensor([[False, False]])
WORLDS = 4


def triggered(period: int, trigger: str = "2s", **bounds: str) -> SystemClock:
    return SystemClock(ClockConfig(trigger=trigger, **bounds), period)


def periods(clock: SystemClock, *spotted: torch.Tensor) -> list[int]:
    found = []
    for flags in spotted:
        clock.tick(flags)
        found.append(clock.period)
    return found


@pytest.mark.parametrize(("clock", "seconds"), [("1s", 1.0), ("0.5m", 30.0), ("1h", 3600.0), ("0.2", 0.2)])
def test_times_are_read_with_their_unit(clock, seconds):
    assert ClockConfig(simulation=clock).dt == seconds


@pytest.mark.parametrize(
    ("clock", "told"),
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
def test_clocks_that_do_not_fit_are_refused(clock, told):
    with pytest.raises(InputError, match="clock") as refused:
        ClockConfig(**clock)
    assert told in str(refused.value)


@pytest.mark.parametrize(
    ("bounds", "told"),
    [
        (
            {"shortest": "12s"},
            "clock.system: 10 steps is out of clock.shortest, clock.longest = 12, 20 steps",
        ),
        ({"longest": "8s"}, "clock.system: 10 steps is out of clock.shortest, clock.longest = 2, 8 steps"),
        ({"trigger": "11s"}, "clock.system: 10 steps is out of clock.shortest, clock.longest = 11, 20 steps"),
    ],
)
def test_a_first_period_out_of_the_bounds_is_refused(bounds, told):
    with pytest.raises(InputError) as refused:
        triggered(10, **bounds)
    assert told in str(refused.value)


def test_a_fixed_clock_never_changes():
    clock = SystemClock(ClockConfig(), 7)
    assert periods(clock, SPOTTED, QUIET, SPOTTED) == [7, 7, 7]
    assert (clock.unit, clock.shortest, clock.longest) == (7, 7, 7)


def test_a_triggered_clock_shrinks_while_the_source_is_spotted_and_grows_otherwise():
    assert periods(triggered(10), SPOTTED, SPOTTED, QUIET, QUIET, QUIET) == [8, 6, 8, 10, 12]


def test_a_triggered_clock_stays_within_its_bounds():
    clock = triggered(10, "4s", shortest="3s", longest="15s")
    assert periods(clock, *[SPOTTED] * 3, *[QUIET] * 5, SPOTTED) == [6, 3, 3, 7, 11, 15, 15, 15, 11]
    assert periods(triggered(10, "4s"), *[SPOTTED] * 3, *[QUIET] * 5) == [6, 4, 4, 8, 12, 16, 20, 20]


@pytest.mark.parametrize(("spotting_worlds", "period"), [(0, 12), (1, 12), (2, 8), (4, 8)])
def test_the_source_counts_as_spotted_from_half_of_the_worlds_on(spotting_worlds, period):
    spotted = torch.zeros(4, 3, dtype=torch.bool)
    spotted[:spotting_worlds, 1:] = True
    assert periods(triggered(10), spotted) == [period]


def test_clocks_are_counted_in_steps_of_the_simulation():
    config = ClockConfig(simulation="0.5s", trigger="2s", shortest="0.1m", longest="20s", system="10s")
    clock = SystemClock(config, config.steps("system"))
    assert (clock.period, clock.change, clock.shortest, clock.longest) == (20, 4, 12, 40)


@pytest.mark.parametrize("first", [7, 10, 12])
@pytest.mark.parametrize("bounds", [{}, {"shortest": "6s", "longest": "15s"}, {"shortest": "1s"}])
def test_every_period_that_can_occur_is_a_multiple_of_the_unit(first, bounds):
    clock, reached, fresh = triggered(first, "3s", **bounds), {first}, [first]
    unit = clock.unit
    while fresh:
        clock.period = fresh.pop()
        start = clock.state_dict()
        for flags in (SPOTTED, QUIET):
            clock.load_state_dict(start)
            fresh += {*periods(clock, flags)} - reached
            reached.add(clock.period)
    assert len(reached) > 2
    assert unit == math.gcd(*reached, clock.shortest, clock.longest)


def test_a_clock_goes_on_from_a_checkpoint():
    one, other = triggered(10), triggered(10)
    periods(one, SPOTTED, SPOTTED)
    other.load_state_dict(one.state_dict())
    assert periods(other, QUIET) == periods(one, QUIET) == [8]


# What is collected between two ticks, as the training recipe does it.


def config(clock: ClockConfig, level_db: float) -> TrainConfig:
    fitted = square(episode=EpisodeConfig(max_steps=7), delay=DelayConfig(obs=2))
    fitted.source.level_db = level_db
    sections = {name: getattr(fitted, name) for name in ("region", "source", "episode", "delay")}
    return TrainConfig(**sections, clock=clock, worlds=WORLDS, backupdate=True)


def batches(config: TrainConfig, n_steps: int, period: int) -> list[tuple[int, TensorDictBase]]:
    """Batches of so many steps together, each with the period that held while it was collected."""
    env, clock = learning_env(config), SystemClock(config.clock, period)
    frames = WORLDS * clock.unit
    collector = Collector(env, random_policy(env), frames_per_batch=frames, total_frames=-1)
    torch.manual_seed(3)
    found, current = [], clock.period
    for batch in ticks(collector, clock):
        found.append((current, batch))
        current = clock.period
        if sum(batch.shape[1] for _, batch in found) >= n_steps:
            break
    collector.shutdown()
    return found


CLOCKS = {"fixed": ClockConfig(), "triggered": ClockConfig(trigger="3s", shortest="2s", longest="12s")}


@pytest.mark.parametrize("kind", CLOCKS)
def test_a_batch_has_the_steps_of_the_current_period_and_none_is_lost_or_doubled(kind):
    setting = config(CLOCKS[kind], level_db=138.0)
    found = batches(setting, 80, 5)
    assert [batch.shape for _, batch in found] == [(WORLDS, period) for period, _ in found]
    changes = {b - a for (a, _), (b, _) in itertools.pairwise(found)}
    assert (changes == {0}) if kind == "fixed" else (min(changes) < 0 < max(changes))
    for (period, batch), (following, _) in itertools.pairwise(found):
        spots = Messages.unpack(batch["next", "agents", "received"][:, -1]).spotted.any(-1)
        assert spots.equal(spotting(batch).any(-1))
        expected = SystemClock(setting.clock, 5)
        expected.period = period
        expected.tick(spots.unsqueeze(-1))
        assert following == expected.period
    pieces = torch.cat([batch for _, batch in found], 1)
    torch.manual_seed(3)
    env = learning_env(setting)
    whole = env.rollout(pieces.shape[1], random_policy(env), break_when_any_done=False)
    assert whole["next", "done"].any()
    for key in whole.keys(True, True):
        assert pieces[key].equal(whole[key]), key


def test_without_delay_the_trigger_is_what_the_uavs_spot():
    loud = config(CLOCKS["triggered"], level_db=170.0)
    quiet = config(CLOCKS["triggered"], level_db=100.0)
    for setting in (loud, quiet):
        setting.delay, setting.backupdate = DelayConfig(), False
    assert [period for period, _ in batches(loud, 10, 5)] == [5, 2, 2, 2]
    assert [period for period, _ in batches(quiet, 30, 5)] == [5, 8, 11, 12]
