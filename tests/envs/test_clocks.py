"""Clocks: valid periods, the triggered system clock, and the batches between two of its ticks."""

import itertools

import pytest
import torch
from helpers import square
from torchrl.collectors import Collector

from damian import ClockConfig, DelayConfig
from damian.baselines.random import random_policy
from damian.common.errors import InputError
from damian.learners.schedule import SystemClock
from damian.recipes.config import TrainConfig
from damian.recipes.shared.learning import learning_env, spotting, ticks
from damian.server.config import EpisodeConfig
from damian.world.messages import Messages

SPOTTED = torch.tensor([[False, True]])
NOT_SPOTTED = torch.tensor([[False, False]])
WORLDS = 4


def triggered(period, trigger="2s", **bounds):
    return SystemClock(ClockConfig(trigger=trigger, **bounds), period)


def periods(clock, *spotted):
    """The period after each tick."""
    result = []
    for flags in spotted:
        clock.tick(flags)
        result.append(clock.period)
    return result


def test_an_impossible_period_is_refused():
    with pytest.raises(InputError, match=r"clock.server: 3s is not a multiple of clock.agents=2s"):
        ClockConfig(agents="2s", server="3s")


def test_a_triggered_clock_stays_within_its_bounds():
    clock = triggered(10, "4s", shortest="3s", longest="15s")
    assert periods(clock, *[SPOTTED] * 3, *[NOT_SPOTTED] * 5, SPOTTED) == [
        6,
        3,
        3,
        7,
        11,
        15,
        15,
        15,
        11,
    ]
    assert periods(triggered(10, "4s"), *[SPOTTED] * 3, *[NOT_SPOTTED] * 5) == [
        6,
        4,
        4,
        8,
        12,
        16,
        20,
        20,
    ]


@pytest.mark.parametrize(
    ("spotting_worlds", "period"),
    [
        (0, 12),
        (1, 12),
        (2, 8),
        (4, 8),
    ],
)
def test_the_period_shrinks_if_the_source_is_spotted_in_half_of_the_worlds_or_more(
    spotting_worlds, period
):
    spotted = torch.zeros(4, 3, dtype=torch.bool)
    spotted[:spotting_worlds, 1:] = True
    assert periods(triggered(10), spotted) == [period]


# Batches that the training recipe collects between two ticks.


def config(clock, level_db):
    scenario = square(episode=EpisodeConfig(max_steps=7), delay=DelayConfig(obs=2))
    scenario.source.level_db = level_db
    sections = {name: getattr(scenario, name) for name in ("region", "source", "episode", "delay")}
    return TrainConfig(**sections, clock=clock, worlds=WORLDS, backupdate=True)


def batches(config, n_steps, period):
    """Batches of ``n_steps`` steps or more in all, each with the system clock's period at that
    time."""
    env = learning_env(config)
    clock = SystemClock(config.clock, period)
    frames = WORLDS * clock.unit
    collector = Collector(env, random_policy(env), frames_per_batch=frames, total_frames=-1)
    torch.manual_seed(3)
    collected = []
    current = clock.period
    for batch in ticks(collector, clock, env.server):
        collected.append((current, batch))
        current = clock.period
        if sum(batch.shape[1] for _, batch in collected) >= n_steps:
            break
    collector.shutdown()
    return collected


CLOCKS = {
    "fixed": ClockConfig(),
    "triggered": ClockConfig(trigger="3s", shortest="2s", longest="12s"),
}


@pytest.mark.parametrize("kind", CLOCKS)
def test_a_batch_has_one_period_of_steps_and_no_step_is_lost_or_doubled(kind):
    setting = config(CLOCKS[kind], level_db=138.0)
    collected = batches(setting, 80, 5)
    server = learning_env(setting).server
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
