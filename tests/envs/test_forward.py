"""Late messages flown forward: exact where nothing is news, and of nothing that arrives later."""

import pytest
import torch
from torchrl.envs import ExplorationType, set_exploration_type

import damian
from damian import keys
from damian.baselines.script import assumed_script, script_policy
from damian.envs.forward import assumed_policy
from damian.models.actor import make_actor
from damian.models.config import SetsConfig

WORLDS, STEPS = 3, 12
LATE = ["observation.own=true", "observation.forward=script"]
CROWDED = "scenario=delaybench/crowded"
CHARGING = f"{CROWDED} motion=polynomial battery=charging battery.capacity_kwh=0.02"


def env_of(words, *more):
    small = ("region.initial_conditions=16", "region.lattice_step=60")
    scenario = damian.compose_scenario(*words.split(), *small, *more)
    env = damian.make_env(scenario, WORLDS, 3, extras=["message"])
    env.assume(assumed_script(env))
    return env


def flown(env, policy):
    return env.rollout(STEPS, policy, break_when_any_done=False)


def same(one, other, *entries):
    for key in entries:
        assert one[key].equal(other[key])


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("scenario", "delay"),
    [
        (f"{CROWDED} aware=timeline", "delay.obs=1..4"),
        (CROWDED, "delay.obs=3 delay.loss=0.2 observation.forward_steps=8"),
        (CHARGING, "delay.obs=1..4"),
    ],
)
def test_without_news_the_late_script_flies_as_the_undelayed_one(scenario, delay):
    undelayed, late = env_of(scenario), env_of(f"{scenario} {delay}", *LATE)
    expected = flown(undelayed, script_policy(undelayed))
    found = flown(late, script_policy(late))
    same(expected, found, keys.ACTION, keys.MESSAGE)
    rows = (found["next", *key] for key in (keys.FORWARD, keys.MESSAGE))
    forward, truth = map(late.server.messages, rows)
    for name in ("time", "position", "target", "trail", "landed"):
        told, sent = getattr(forward, name), getattr(truth, name).unsqueeze(2)
        assert told.equal(sent.expand_as(told)), name
    # The battery at takeoff is known up to rounding.
    assert (forward.battery - truth.battery.unsqueeze(2)).abs().max() < 1e-4
    place = undelayed.layout["observation"]["place"].columns
    others = undelayed.layout["observation"]["others"].columns
    for columns in (place, others):
        after = ("next", *keys.OBSERVATION)
        assert expected[after][..., columns].equal(found[after][..., columns])


HELD = "actions.command=absolute delay.act_hold=max delay.act=1..2"


def targets(env, rollout):
    return env.server.messages(rollout["next", *keys.MESSAGE]).target


@pytest.mark.parametrize("delay", ["delay.obs=0", "delay.obs=1..3"])
def test_without_news_late_commands_fly_as_undelayed_ones_but_later(delay):
    undelayed, late = env_of(CROWDED), env_of(f"{CROWDED} {HELD} {delay}", *LATE)
    expected = targets(undelayed, flown(undelayed, script_policy(undelayed)))
    found = targets(late, flown(late, script_policy(late)))
    assert found[:, 2:].equal(expected[:, :-2])
    assert not found[:, 2:].equal(found[:, :-2])


def test_who_flies_late_commands_forward_knows_what_it_has_sent_itself():
    words = "agents=1 observation.global_features=[coverage,coverage_map]"
    env = env_of(f"{CROWDED} {HELD} delay.obs=1..3 {words}", *LATE)
    torch.manual_seed(0)
    after = after_actions(env, torch.randint(40, (STEPS, WORLDS, 1)))
    for now, later in zip(after, after[2:], strict=False):
        forward = env.server.messages(now[keys.FORWARD][:, 0])
        truth = env.server.messages(later[keys.MESSAGE])
        assert forward.target.equal(truth.target)
        assert now[keys.FRAME].equal(truth.trail[..., 0])


def test_a_policy_that_everybody_follows_is_flown_forward():
    undelayed = env_of("scenario=tasks/flights")
    late = env_of("scenario=tasks/flights delay.obs=1..3", *LATE)
    torch.manual_seed(0)
    actor = make_actor(undelayed, SetsConfig(hidden=[8], width=4))
    late.assume(assumed_policy(late.uav_env.simulation, late.server, actor))
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = flown(undelayed, actor)
        found = flown(late, actor)
    same(expected, found, keys.ACTION, ("next", *keys.OBSERVATION))
    assert len(found[keys.ACTION].unique()) > 3


def after_actions(env, actions):
    """The entries after steps of these actions [STEPS, B, N], each."""
    entries = env.reset()
    found = []
    for action in actions:
        entries = env.step(entries.set(keys.ACTION, action))["next"]
        found.append(entries)
    return found


def test_what_has_arrived_is_told_and_nothing_that_has_not():
    """Others do what nobody expects; what they do in the last three steps arrives too late."""
    words = f"{CROWDED} delay.obs=3 aware=timeline"
    torch.manual_seed(0)
    actions = torch.randint(40, (STEPS, WORLDS, 3))
    changed = actions.clone()
    changed[-3:, :, 1:] = torch.randint(40, (3, WORLDS, 2))
    env = env_of(words, *LATE)
    found = after_actions(env, actions)
    of_changed = after_actions(env_of(words, *LATE), changed)
    sent, sent_changed = found[-1][keys.MESSAGE], of_changed[-1][keys.MESSAGE]
    assert not sent[:, 1:].equal(sent_changed[:, 1:])
    undisturbed = (sent[:, 0] == sent_changed[:, 0]).all(-1)
    assert undisturbed.any()
    told, told_changed = (each[-1][keys.FORWARD][:, 0] for each in (found, of_changed))
    assert told[undisturbed].equal(told_changed[undisturbed])
    expected, forward, truth = map(env.server.messages, (found[-4][keys.MESSAGE], told, sent))
    assert forward.trail[..., 3:].equal(expected.trail[..., :-3])
    assert not forward.trail[:, 1:].equal(truth.trail[:, 1:])
