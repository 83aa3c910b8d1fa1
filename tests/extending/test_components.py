"""The files of examples/extending run from outside the package, and a mistake in them is one clear
line."""

import csv
import sys

import pytest
from extensions import TINY
from helpers import SQUARE, check_refused, everything

from damian import make_env
from damian.common.errors import InputError
from damian.runs.run_folder import read_results
from damian.server.config import ObservationConfig, RewardConfig
from damian.world.config import RegionConfig

LAW = ["delay.obs={law: law:Satellite, hop: 2s, extra: 0.3}"]
LAW += ["delay.act={law: law:Distance, antenna: [0, 20], speed: 40, reach: 90}"]
LAW += ["delay.rew={law: law:Route, longest: 3s, change: 0.5}"]
FEATURES = [
    "observation.local_features=[spotted,features:heading,sensor:wind_felt]",
    "observation.global_features=[features:spread]",
]
LOW = "{term: rewards:low_battery, weight: -0.2, below: 0.5}"
REWARDS = ["scenario=energy", f"reward.custom=[{LOW}, {{term: rewards:together, weight: 0.1}}]"]
REGION = ["region=vertices", "region.kind=region:yard", "region.options={side: 200}"]
REGION += ["region.lattice_step=40"]
MOTION = [
    "motion=polynomial",
    "motion.kind=motion:WindyFlight",
    "motion.options={wind: 4, bearing: 0}",
]
METRIC = "metrics=[metric:apart]"
SENSOR = "sensors=[{sensor: sensor:wind, strength: 3}]"


def test_components_of_ones_own_are_trained_with_logged_and_evaluated(run):
    folder = run(
        *TINY,
        *REWARDS,
        *LAW,
        *FEATURES,
        *REGION,
        *MOTION,
        SENSOR,
        METRIC,
        "aware=backupdate+history",
    )
    assert read_results(folder / "result.csv")["metric:apart"].between(0, 1).all()
    assert "metric:apart" in (folder / "result.md").read_text()
    with (folder / "metrics.csv").open(newline="") as file:
        last = list(csv.DictReader(file))[-1]
    assert {"reward/low_battery", "reward/together", "reward/battery"} <= last.keys()
    assert float(last["reward/together"]) > 0


@pytest.mark.sample(3)
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["delay.obs={law: law:Satelite}"],
            "delay.obs.law: law:Satelite: the module law has no Satelite",
        ),
        (
            ["sensors=[{sensor: sensor:wind, strenght: 3}]"],
            "sensors[0].strenght: 3 is not a parameter of",
        ),
        ([*REGION[:2], "region.options={sid: 50}"], "region.options: sid is not one of side"),
    ],
)
def test_a_mistake_is_one_clear_line(run, folder, capsys, overrides, message):
    before = {path.name for path in folder.iterdir()} | {"__pycache__"}
    check_refused(lambda: run(*TINY, *overrides), message, capsys)
    assert {path.name for path in folder.iterdir()} <= before


LIES = """
import torch
from damian import feature, reward_term, sensor

@feature("local")
def radians(cache):
    return cache.messages.track + 4

@feature("local")
def leaks(cache):
    return cache.messages.track.mean(-1, keepdim=True).expand(cache.messages.track.shape) / 7

@feature("local")
def meets(cache):
    stops = cache.messages.trail[..., 0]
    return (stops.sum(-1, keepdim=True).expand(stops.shape) % 7) / 7

@reward_term(reads=["spotted"], scope="system")
def shared(features, counters):
    return features["spotted"].T

@reward_term(reads=["spotted"])
def fails(features, counters):
    return features["spotted"] / None

@sensor(width=2)
def flipped(state, world):
    return state.position[..., :2].transpose(0, 1)

"""


def seen(name):
    return {"observation": ObservationConfig([f"lies:{name}"], [])}


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        (seen("radians"), r"feature lies:radians: 4 is not between 0 and 1"),
        (seen("leaks"), "lies:leaks: local changes with the messages of other UAVs: make it glob"),
        (seen("meets"), "lies:meets: local changes with the messages of other UAVs"),
        (
            {"reward": RewardConfig(custom=[{"term": "lies:shared"}])},
            r"reward term shared: shape: \[3, 20\] is not \[20, 3\]",
        ),
        (
            {"reward": RewardConfig(spotted=1.0, custom=[{"term": "lies:fails"}])},
            r"reward term fails: TypeError",
        ),
        (
            {"sensors": [{"sensor": "lies:flipped"}]},
            r"sensor flipped: shape: \[3, \d+, 2\] is not \[\d+, 3, 2\]",
        ),
    ],
)
def test_a_component_that_does_not_keep_what_it_declares_is_one_line_before_anything_is_flown(
    folder, monkeypatch, sections, message
):
    (folder / "lies.py").write_text(LIES)
    monkeypatch.delitem(sys.modules, "lies", raising=False)
    region = RegionConfig(
        kind="vertices", vertices=SQUARE, lattice_step=40.0, initial_conditions=20
    )
    with pytest.raises(InputError, match=message):
        make_env(everything(region=region, **sections), 2)


@pytest.mark.slow
def test_components_of_ones_own_are_compiled(run):
    own = ["observation.local_features=[spotted,features:heading]", *FEATURES[1:]]
    run(*TINY, *REWARDS, *LAW, *own, *REGION, *MOTION, "compile=true")
