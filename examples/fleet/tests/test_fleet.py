"""The service observes and advises what the simulation does, from what the UAVs report."""

from dataclasses import replace

import pytest
import torch
from field import FLIGHTS, SEEN, flights, scenario_of

from damian import keys
from damian.baselines.script import script_policy
from damian.delays.config import DelayConfig
from damian.learners.config import MappoConfig
from damian.models.config import MlpConfig
from damian.models.memory import add_recurrent_state
from damian.server.config import ObservationConfig

LATE = {"law": "uniform", "low": 0, "high": 4}


def recurrent(env):
    """A policy with random weights and hidden states, the same for every environment of a
    scenario."""
    torch.manual_seed(7)
    actor = MappoConfig().make_actor(env, MlpConfig(hidden=[16], rnn="gru"))
    add_recurrent_state(env, actor)
    return actor


TASKS = {
    "the last to arrive": (
        script_policy,
        {"delay": DelayConfig(obs=LATE, loss=0.2, order="arrival")},
    ),
    "flights": (
        recurrent,
        {
            "delay": DelayConfig(obs=LATE, loss=0.2, history=2),
            "observation": replace(SEEN, belief=["belief_gain", "belief_moments"]),
            "motion": replace(FLIGHTS, sensing_time=2.0),
        },
    ),
    "timeline": (
        script_policy,
        {
            "delay": DelayConfig(obs=LATE),
            "motion": FLIGHTS,
            "observation": ObservationConfig(["place"], ["others"], timeline=6),
        },
    ),
}


@pytest.mark.parametrize("task", TASKS)
def test_a_fleet_observes_and_advises_what_the_simulation_does_bit_for_bit(task):
    policy_of, changed = TASKS[task]
    moved = 0
    n_steps = 60 if "motion" in changed else 25
    fraction = 0.7 * (task == "flights")
    scenario = scenario_of(**changed)
    for shown, field, action, ready, step in flights(scenario, policy_of, n_steps, fraction):
        fleet = field.fleet
        read = field.fleet.tracker.read(ready)
        for key in (keys.OBSERVATION, keys.ACTION_MASK, keys.TIMELINE):
            if key in shown.keys(True):
                assert torch.equal(read[key], shown[key]), (step, key)
        assert torch.equal(read[keys.RECEIVED], shown.get(keys.RECEIVED, shown[keys.MESSAGE])), step
        if not ready:
            continue
        chosen = torch.tensor([[each in ready for each in fleet.uavs]])
        goals = fleet.node.simulation.decide(fleet.tracker.state(ready), action, chosen).goal[0]
        told = field.ask_all(ready)
        assert [each.ID for each in told] == ready
        for each in told:
            goal = int(goals[fleet.tracker.uavs.index(each.ID)])
            assert (each.reason, each.lat, each.lon) == (None, *fleet.ground.place(goal))
            field.say(each.ID, each.answer, "accepted")
            if each.state == "fly":
                moved += field.say(each.ID, each.answer, "taken off") == "taken off"
    assert moved > 3
