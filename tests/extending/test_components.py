"""The files of examples/extending run from outside the package, and a mistake in them is one clear line."""

import csv
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from extensions import TINY
from helpers import act, check_refused, everything, one_uav
from torchrl.envs.utils import check_env_specs

from damian import UavEnv, make_env
from damian.delays.config import DelayConfig
from damian.server.features import ObservationConfig
from damian.server.rewards import RewardConfig
from damian.settings import ClockConfig
from damian.world.motion import MotionConfig
from damian.world.regions.config import RegionConfig

LAW = ["delay.obs={law: law:Satellite, hop: 2s, extra: 0.3}"]
LAW += ["delay.act={law: law:Distance, antenna: [0, 20], speed: 40, reach: 90}"]
FEATURES = [
    "observation.local_features=[spotted,features:heading]",
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


SENSOR = [
    "sensors=[{sensor: sensor:wind, strength: 3}]",
    "observation.local_features=[spotted,sensor:wind_felt]",
]


def check_trained_and_evaluated(run: Callable[..., Path], *overrides: str) -> dict[str, str]:
    """Train and evaluate with extensions; returns the last row of the metrics."""
    first = run(*TINY, *overrides)
    second = run(f"checkpoint={first}", "seed=1", "trust=true", program="evaluate", name="evaluated")
    assert (second / "result.csv").is_file()
    with (first / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))[-1]


def test_a_law_features_and_reward_terms_of_ones_own_are_trained_with_and_logged(run):
    last = check_trained_and_evaluated(run, *REWARDS, *LAW, *FEATURES)
    assert {"reward/low_battery", "reward/together", "reward/battery"} <= last.keys()
    assert float(last["reward/together"]) > 0


def test_a_region_and_a_motion_model_of_ones_own_are_trained_in(run):
    check_trained_and_evaluated(run, *REGION, *MOTION)


def test_a_sensor_and_a_feature_that_reads_it_are_trained_with(run):
    check_trained_and_evaluated(run, *SENSOR, "delay=paper", "aware=both", "motion=polynomial")


@pytest.mark.parametrize("compiles", [False, True])
@pytest.mark.slow
def test_extensions_do_the_same_compiled_and_back_updated_steps_know_them(folder, compiles):
    scenario = everything(
        observation=ObservationConfig(["spotted", "features:heading"], ["features:spread", "source_time"]),
        reward=RewardConfig(custom=[{"term": "rewards:together", "weight": 0.5}]),
        delay=DelayConfig(
            obs={"law": "law:Distance", "antenna": [30, 0], "speed": 40, "capacity": 2, "reach": 60},
            act={"law": "law:Satellite", "hop": 1, "extra": 0.5},
        ),
    )
    env, other = (make_env(scenario, 4, seed=2, extras=["message", "reward_terms"]) for _ in range(2))
    other = other.compile(backend="eager") if compiles else other
    torch.manual_seed(0)
    one = env.rollout(12, break_when_any_done=False)
    torch.manual_seed(0)
    two = other.rollout(12, break_when_any_done=False)
    assert all(one[key].equal(two[key]) for key in one.keys(True, True))
    assert env.server.reward.terms[-1] == "together"
    together = one["next", "agents", "reward_terms", "together"]
    spread = 1 - one["next", "agents", "global_observation"][..., 0]
    torch.testing.assert_close(together, 0.5 * spread)


def test_each_delay_of_distance_is_that_of_its_message(folder):
    law = {"law": "law:Distance", "antenna": [30, -40], "speed": 40, "capacity": 2, "reach": 90, "longest": 3}
    scenario = everything("polynomial", delay=DelayConfig(obs=law), clock=ClockConfig("2s"))
    rollout = make_env(scenario, 8, extras=["message"]).rollout(30, break_when_any_done=False)[
        "next", "agents"
    ]
    sent, delay = rollout["message_sent"], rollout["delay"].squeeze(-1)
    east, north = rollout["position"].double().unbind(-1)
    metres = ((east - 30) ** 2 + (north + 40) ** 2).sqrt()
    expected = (metres / 80 + sent.sum(-1, keepdim=True) // 2).ceil().clamp(max=3).long()
    arrives = sent & (delay >= 0)
    assert delay[arrives].equal(expected[arrives])
    assert arrives[sent & (metres < 89)].all()
    assert 0.3 < arrives[sent & (metres > 91)].double().mean() < 0.7
    assert len(delay[arrives].unique()) > 2


@pytest.mark.sample(3)
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["delay.obs={law: law:Satelite}"], "delay.obs.law: law:Satelite: the module law has no Satelite"),
        (["delay.obs={law: laws:Satellite}"], "delay.obs.law: laws:Satellite: No module named 'laws'"),
        (["delay.obs={law: law:Satellite, hops: 2}"], "delay.obs.hops: 2 is no setting of the law law:Satel"),
        (["delay.obs={law: features:heading}"], "delay.obs.law: features:heading is no dataclass derived"),
        (["sensors=[{sensor: sensor:wind, strenght: 3}]"], "sensors[0].strenght: 3 is no parameter of"),
        (
            ["observation.local_features=[features:spread]"],
            "features:spread is a global feature, not a local",
        ),
        (["reward.custom=[rewards:together]"], "reward.custom[0]: rewards:together is not {term: package"),
        (["reward.custom=[{term: law:Satellite}]"], "reward.custom[0].term: law:Satellite is no reward term"),
        (["region.kind=region:yard", "region.options={sid: 50}"], "region.options.sid: 50 is not one of its"),
        (["motion.kind=law:Satellite"], "motion.kind: law:Satellite is no class derived from"),
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


def test_head_wind_makes_flights_longer_and_tail_wind_shorter(folder):
    durations = {}
    for bearing in (0, 180):  # where the wind comes from
        motion = MotionConfig("motion:WindyFlight", max_speed=20.0, options={"wind": 5, "bearing": bearing})
        env = UavEnv(one_uav(motion=motion), extras=[])
        env.reset()
        act(env, torch.tensor([[[0.9, 0.25]]]))  # 90 m to the east: across the wind
        across = env.state.cruise.item()
        act(env, torch.tensor([[[0.5, 0.0]]]))
        while not env.simulation.ready(env.state).all():
            act(env, torch.tensor([[[0.0, 0.0]]]))
        act(env, torch.tensor([[[0.5, 0.0]]]))  # 50 m to the north
        durations[bearing] = across, env.state.cruise.item()
    assert durations[0][0] == pytest.approx(durations[180][0], rel=1e-4)
    assert durations[0][1] == pytest.approx(durations[180][1] * (20 + 5) / (20 - 5), rel=1e-4)


def test_a_region_of_ones_own_is_flown_over(folder):
    env = UavEnv(everything(region=RegionConfig("region:yard", options={"side": 200.0}, lattice_step=40.0)))
    assert env.simulation.airspace.regions[0].name == "L-shaped yard"
    assert env.simulation.airspace.regions[0].polygon.area == pytest.approx(0.75 * 200**2)
