"""``make_env``: the messages that the server holds, the action history, and clocks."""

from dataclasses import replace

import pytest
import torch
from delayed_envs import choices, delayed
from helpers import FLYING, KEEPS_GOING, all_same, everything, play, square

from damian import ClockConfig, DelayConfig, UavEnv
from damian.envs.pipeline import action_codes
from damian.keys import ACTION, OBSERVATION, READY, RECEIVED
from damian.world.landing import action_table
from damian.world.messages import Messages

# The messages that the server holds, and their age of information.


def test_the_action_history_holds_the_chosen_displacements_east_and_north():
    scenario = square(delay=DelayConfig(act=2, history=2), episode=KEEPS_GOING)
    env = delayed(scenario)
    undelayed = UavEnv(square(), 4)
    actions = choices(env, 6)
    distance, heading = action_table(scenario.actions).unbind(-1)
    displacements = torch.stack([distance * heading.sin(), distance * heading.cos()], -1)
    codes = (displacements / 200 + 1) / 2
    outputs = play(env, actions)
    for t in range(2, 6):
        expected = torch.cat([codes[actions[t - 1]], codes[actions[t]]], -1)
        observation = outputs[2 * t + 1][OBSERVATION]
        assert observation.shape[-1] == undelayed.observation_spec[OBSERVATION].shape[-1] + 4
        torch.testing.assert_close(
            observation[..., -4:],
            expected,
            rtol=0,
            atol=1e-6,
        )


@pytest.mark.parametrize(
    "obs",
    [
        2,
        {
            "law": "uniform",
            "low": 0,
            "high": 5,
            "probability": 1.0,
        },
    ],
)
def test_the_history_shows_a_flight_until_the_server_hears_of_its_end(obs):
    delay = DelayConfig(obs=obs, history=3)
    motion = replace(FLYING, sensing_time=4.0)
    env = delayed(square(motion=motion, delay=delay, episode=KEEPS_GOING), 16)
    codes = action_codes(env.scenario.actions)
    points = env.uav_env.simulation.points
    td = env.reset()
    known = 0
    unknown = 0
    latest, chosen_at = torch.zeros(2, 16, 3, dtype=torch.long)
    for step, action in enumerate(choices(env, 60)):
        latest = torch.where(td[READY], action, latest)
        chosen_at = torch.where(td[READY], step, chosen_at)
        td = env.step(td.set(ACTION, action))["next"]
        state = env.uav_env.state
        flew = state.goal != state.origin
        held = Messages.unpack(td[RECEIVED])
        heard = (held.position == points[state.goal]).all(-1) & (held.time > chosen_at)
        shown = (td[OBSERVATION][..., -2:] == codes[latest]).all(-1)
        assert (shown == ~heard)[flew].all()
        known = known + int((flew & heard).sum())
        unknown = unknown + int((flew & ~heard).sum())
    assert min(known, unknown) > 100


# Clocks.


@pytest.mark.sample(5)
@pytest.mark.parametrize(
    "act",
    [
        0,
        2,
        {
            "law": "geometric",
            "mean": 2,
        },
    ],
)
@pytest.mark.parametrize(
    ("motion", "agents"),
    [
        ("instant", "3s"),
        ("polynomial", "1s"),
        ("polynomial", "3s"),
    ],
)
def test_an_action_chosen_while_not_ready_is_never_executed(act, motion, agents):
    delay = DelayConfig(obs=1, act=act, history=2)
    scenario = everything(motion, delay=delay, clock=ClockConfig(agents=agents))
    rollouts = []
    n_ignored = 0
    for changed in (False, True):
        env = delayed(scenario)
        td = env.reset()
        outputs = []
        for action, other in zip(choices(env, 15), choices(env, 16)[1:], strict=True):
            n_ignored += (~td[READY]).sum().item()
            chosen = torch.where(td[READY] | (not changed), action, other)
            stepped, td = env.step_and_maybe_reset(td.set(ACTION, chosen))
            outputs += [stepped["next"].clone(), td.exclude(ACTION)]
        rollouts.append(outputs)
    assert all_same(*rollouts)
    assert n_ignored > 50
