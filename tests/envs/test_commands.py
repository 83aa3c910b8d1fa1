"""Absolute commands: they lead to the same place wherever they arrive, and agents know what they
have sent."""

from dataclasses import replace

import pytest
import torch
from helpers import both_kinds, both_motions, everything, play, random_actions, square
from torchrl.envs.utils import check_env_specs

from damian import UavEnv, make_env
from damian.common.errors import InputError
from damian.delays.config import DelayConfig, LinkConfig
from damian.delays.samplers import Sampler
from damian.envs.commands import destination
from damian.envs.config import ClockConfig
from damian.keys import ACTION, ACTION_MASK, COMMANDS, FRAME, GLOBAL_OBSERVATION, OBSERVATION
from damian.server.config import EpisodeConfig, ObservationConfig
from damian.world.config import (
    ActionConfig,
    BatteryConfig,
    MotionConfig,
    RegionConfig,
    WindConfig,
)

ABSOLUTE = ActionConfig(command="absolute")
LONG = EpisodeConfig(max_steps=1000)
WIDE = RegionConfig(
    kind="vertices", vertices=[[0, 0], [600, 0], [600, 600], [0, 600]], lattice_step=40.0
)


class Scripted(Sampler):
    """The delays of a list, one after the other; 3 for a lost one."""

    def __init__(self, delays):
        super().__init__(2)
        self.delays = torch.tensor(delays)

    def forward(self, streams, clock, state, context=None):
        return self.delays[clock % len(self.delays)].expand_as(streams), state


PUNCTUAL = Scripted([0])
"""Delays that may be late, and never are."""

FLIGHTS = MotionConfig(kind="polynomial", max_speed=20.0, max_acceleration=10.0)
WORLDS = {
    "everything": {},
    "flights": {"motion": FLIGHTS},
    "zones": {"region": RegionConfig(min_area=60_000, max_area=90_000, zones=2)},
    "unequal UAVs": {"motion": replace(FLIGHTS, max_speed=[5.0, 10.0, 20.0])},
    "wind": {"motion": FLIGHTS, "wind": WindConfig(speed=8.0, direction=30.0, gusts=1.0)},
}


@pytest.mark.parametrize("name", WORLDS)
@both_kinds
def test_an_absolute_command_that_arrives_at_once_is_the_relative_one(name, kind):
    scenario = replace(everything(kind=kind), **WORLDS[name])
    env = UavEnv(scenario, 8)
    env.reset()
    relative = absolute = env.worlds
    generator = torch.Generator().manual_seed(0)
    for t in range(30):
        action = random_actions(env, generator)
        goal = env.simulation.layout.unpack(absolute).goal
        command = torch.stack([goal, torch.full_like(goal, t + 1)], -1)
        relative, outputs = env.step_fn(relative, action)
        absolute, same = env.step_fn(absolute, action, None, command)
        assert all(one.equal(other) for one, other in zip(relative, absolute, strict=True))
        assert all(outputs[key].equal(same[key]) for key in outputs)


@both_kinds
@both_motions
def test_with_commands_that_arrive_at_once_agents_see_what_they_saw_without(motion, kind):
    shown = []
    for command in ("relative", "absolute"):
        delay = DelayConfig(act=PUNCTUAL, obs=2)
        scenario = everything(motion, kind, delay=delay)
        scenario.observation.own = True
        scenario.actions = ActionConfig(kind, command=command)
        env = make_env(scenario, 4)
        generator = torch.Generator().manual_seed(0)
        outputs = play(env, lambda _: random_actions(env.uav_env, generator), 20)  # noqa: B023
        shown.append(torch.stack([td.exclude(FRAME, COMMANDS) for td in outputs[1::2]]))
    relative, absolute = shown
    for key in relative.keys(True, True):
        if key != GLOBAL_OBSERVATION:  # without commands, the critic knows no message at once
            assert relative[key].equal(absolute[key]), key


def free_actions(env, frame, generator):
    """Random actions [B, N] of which none leads to where another UAV is or will be."""
    candidates = env.uav_env.simulation.candidates
    n_worlds, n = frame.shape
    while True:
        action = random_actions(env.uav_env, generator)
        goal = destination(candidates, frame, action)
        others = torch.eye(n) == 0
        clash = (goal.unsqueeze(-1) == frame.unsqueeze(-2)) & others.bool()
        clash |= (goal.unsqueeze(-1) == goal.unsqueeze(-2)) & others.bool()
        if not clash.any():
            return action


@pytest.mark.parametrize("own", [False, True], ids=["all late", "own at once"])
@pytest.mark.parametrize(("obs", "act"), [(0, 2), (2, 1), (1, 3)])
def test_a_delay_of_held_commands_is_a_longer_delay_of_what_is_observed(obs, act, own):
    names = ["others", "coverage_map"]
    observation = ObservationConfig(["place", "number"], names, timeline=8, stops=8, window=3)
    common = {"region": WIDE, "observation": observation, "episode": LONG}
    observation.own = own
    law = {"law": "uniform", "low": 0, "high": act}
    late = DelayConfig(obs=obs, act=law, act_hold="max")
    commanded = make_env(square(**common, delay=late, actions=ABSOLUTE), 2)
    observation.own = True
    watched = make_env(square(**common, delay=DelayConfig(obs=obs + act)), 2)
    generator = torch.Generator().manual_seed(1)
    first = commanded.reset()
    second = watched.reset()
    hold = torch.zeros(2, 3, dtype=torch.long)
    for _ in range(act):
        second = watched.step(second.set(ACTION, hold))["next"]
    for t in range(20):
        one = {block.name: block.of(first[OBSERVATION]) for block in commanded.layout["observation"]}
        other = {block.name: block.of(second[OBSERVATION]) for block in watched.layout["observation"]}
        assert first[FRAME].equal(watched.uav_env.state.goal)
        for name in ["place", "number", *names]:
            assert one[name].equal(other[name]), (t, name)
        told = one["timeline"][..., : 8 - act, :]
        assert told.equal(other["timeline"][..., act:8, :])
        assert first[ACTION_MASK].equal(second[ACTION_MASK])
        action = free_actions(commanded, first[FRAME], generator)
        first = commanded.step(first.set(ACTION, action))["next"]
        second = watched.step(second.set(ACTION, action))["next"]
