"""The files of examples/extending run from outside the package, and a mistake in them is one clear line."""

import csv

import pytest
import torch
from extensions import TINY
from helpers import check_refused, everything
from torchrl.envs.utils import check_env_specs

from damian import UavEnv, make_env
from damian.server.features import ObservationConfig
from damian.server.rewards import RewardConfig
from damian.world.regions.config import RegionConfig

LAW = ["delay.obs={law: law:Satellite, hop: 2s, extra: 0.3}"]
LAW += ["delay.act={law: law:Distance, antenna: [0, 20], speed: 40, reach: 90}"]
FEATURES = [
    "observation.local_features=[spotted,features:heading,sensor:wind_felt]",
    "observation.global_features=[features:spread]",
]
LOW, TOGETHER = (
    "{term: rewards:low_battery, weight: -0.2, below: 0.5}",
    "{term: rewards:together, weight: 0.1}",
)
REWARDS = ["scenario=energy", f"reward.custom=[{LOW}, {TOGETHER}]"]
REGION = [
    "region=vertices",
    "region.kind=region:yard",
    "region.options={side: 200}",
    "region.lattice_step=40",
]
MOTION = ["motion=polynomial", "motion.kind=motion:WindyFlight", "motion.options={wind: 4, bearing: 0}"]
SENSOR = "sensors=[{sensor: sensor:wind, strength: 3}]"


def test_components_of_ones_own_are_trained_with_logged_and_evaluated(run):
    first = run(*TINY, *REWARDS, *LAW, *FEATURES, *REGION, *MOTION, SENSOR, "aware=both")
    second = run(f"checkpoint={first}", "seed=1", "trust=true", program="evaluate", name="evaluated")
    assert (second / "result.csv").is_file()
    with (first / "metrics.csv").open(newline="") as file:
        last = list(csv.DictReader(file))[-1]
    assert {"reward/low_battery", "reward/together", "reward/battery"} <= last.keys()
    assert float(last["reward/together"]) > 0


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["delay.obs={law: law:Satelite}"], "delay.obs.law: law:Satelite: the module law has no Satelite"),
        (["sensors=[{sensor: sensor:wind, strenght: 3}]"], "sensors[0].strenght: 3 is not a parameter of"),
        ([*REGION[:2], "region.options={sid: 50}"], "region.options.sid: 50 is not one of its"),
    ],
)
def test_a_mistake_is_one_clear_line(run, folder, capsys, overrides, message):
    before = {path.name for path in folder.iterdir()} | {"__pycache__"}
    check_refused(lambda: run(*TINY, *overrides), message, capsys)
    assert {path.name for path in folder.iterdir()} <= before


def test_observations_and_rewards_are_float32_whatever_a_component_returns(folder):
    (folder / "exact.py").write_text(EXACT)
    scenario = everything(
        observation=ObservationConfig(["exact:flag", "exact:precise"], []),
        reward=RewardConfig(custom=[{"term": "exact:counted"}]),
    )
    env = make_env(scenario, 2)
    check_env_specs(env)
    found = env.rollout(3)["next", "agents"]
    assert {found[name].dtype for name in ("observation", "reward")} == {torch.float32}


EXACT = """
from damian import feature, reward_term

@feature("local")
def flag(cache):
    return cache.messages.spotted

@feature("local")
def precise(cache):
    return cache.messages.battery.double() / 100

@reward_term(reads=["spotted"])
def counted(features, counters):
    return features["spotted"].double()
"""


def test_a_region_of_ones_own_is_flown_over(folder):
    env = UavEnv(everything(region=RegionConfig("region:yard", options={"side": 200.0}, lattice_step=40.0)))
    assert env.simulation.airspace.regions[0].name == "L-shaped yard"
    assert env.simulation.airspace.regions[0].polygon.area == pytest.approx(0.75 * 200**2)


@pytest.mark.slow
def test_components_of_ones_own_are_compiled(run):
    own = ["observation.local_features=[spotted,features:heading]", *FEATURES[1:]]
    run(*TINY, *REWARDS, *LAW, *own, *REGION, *MOTION, "compile=true")
