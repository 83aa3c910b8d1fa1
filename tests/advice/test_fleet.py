"""The server node outside the simulation observes what the one inside does, from what the UAVs report."""

from dataclasses import replace

import pytest
import torch
from reporting import flights

from damian import keys
from damian.baselines.greedy import greedy_policy
from damian.delays.config import DelayConfig
from damian.envs.clocks import ClockConfig
from damian.envs.scenario import ScenarioConfig
from damian.server.features import ObservationConfig
from damian.server.termination import EpisodeConfig
from damian.world.landing import ActionConfig
from damian.world.motion import MotionConfig
from damian.world.regions.config import RegionConfig
from damian.world.signal_source import SourceConfig

LLANBEDR = RegionConfig(kind="fir", path="damian:fir.csv", id="LlanbedrTest", initial_conditions=1)
"""With a single initial condition, whose table of first observations rounds as that of a single fleet."""
LATE = {"law": "uniform", "low": 0, "high": 4}
BELIEF = ["belief_gain", "belief_moments"]
WALK = SourceConfig(motion="dynamic", level_db=143.0, emission="per_step", emission_probability=0.6)


def scenario_of(**changed) -> ScenarioConfig:
    endless = {"episode": EpisodeConfig(max_steps=None), "region": LLANBEDR, "source": WALK}
    return ScenarioConfig(**{**endless, "agents": 3, **changed})


FEATURES = ["source_distance", "source_bearing", "source_time", "source_drift", "agent_distances", "coverage"]
SEEN = ObservationConfig(global_features=FEATURES, local_features=["spotted", "battery"], age=True)
TASKS = {
    "on time": {"observation": SEEN},
    "late": {"delay": DelayConfig(obs=LATE, loss=0.2), "observation": SEEN},
    "the last to arrive": {"delay": DelayConfig(obs=LATE, loss=0.2, order="arrival"), "observation": SEEN},
    "held back": {"delay": DelayConfig(obs=LATE, hold="max"), "observation": SEEN},
    "history": {"delay": DelayConfig(obs=LATE, loss=0.2, history=3, messages=5), "observation": SEEN},
    "belief": {"delay": DelayConfig(obs=LATE, loss=0.2), "observation": replace(SEEN, belief=BELIEF)},
    "clocks": {
        "delay": DelayConfig(obs=LATE, history=2),
        "observation": SEEN,
        "clock": ClockConfig(agents="2s", server="4s"),
    },
    "flights": {
        "delay": DelayConfig(obs=LATE, loss=0.2, history=2),
        "observation": replace(SEEN, belief=BELIEF),
        "motion": MotionConfig(kind="polynomial", max_speed=20.0, max_acceleration=10.0, sensing_time=2.0),
    },
    "continuous": {
        "delay": DelayConfig(obs=LATE, loss=0.2),
        "observation": SEEN,
        "actions": ActionConfig(kind="continuous"),
    },
    "a region of metres": {
        "delay": DelayConfig(obs=LATE),
        "observation": SEEN,
        "region": RegionConfig(initial_conditions=1),
    },
}


@pytest.mark.parametrize(
    ("task", "fraction"), [*((task, 0.0) for task in TASKS), ("late", 0.7), ("flights", 0.7)]
)
def test_a_fleet_observes_and_advises_what_the_simulation_does_bit_for_bit(task, fraction):
    scenario = scenario_of(**TASKS[task])
    spotted, moved, n_steps = 0, 0, 90 if task == "flights" else 40
    for shown, fleet, action, ready, step in flights(scenario, greedy_policy, n_steps, fraction=fraction):
        read = fleet.observe(ready)
        for key in (keys.OBSERVATION, keys.ACTION_MASK, keys.HISTORY):
            if key in shown.keys(True):
                assert torch.equal(read[key], shown[key]), (step, key)
        held = shown.get(keys.RECEIVED, shown[keys.MESSAGE])
        assert torch.equal(read[keys.RECEIVED], held), step
        chosen = fleet.advise(fleet.clock, [fleet.uavs[uav] for uav in ready])
        assert chosen == ready
        assert torch.equal(fleet.action[0, ready], action[0, ready])
        spotted += sum(known.spotted for known in fleet.held)
        assert all(here.report.time <= fleet.clock for here in fleet.held)
        moved += sum(fleet.decision(uav).origin != fleet.decision(uav).goal for uav in ready)
    assert moved > 3
    assert spotted > 0
