"""``UavEnv`` as a TorchRL environment: specs, skipped steps and seeds."""

import pytest
import torch
from helpers import (
    KINDS,
    MOTIONS,
    REGIONS,
    both_kinds,
    both_motions,
    everything,
    random_actions,
    same,
)
from torchrl.envs.utils import check_env_specs
from twin import GLOBAL, LOCAL

from damian import DelayConfig, ScenarioConfig, UavEnv, make_env
from damian.envs import uav_env
from damian.keys import ACTION
from damian.server.config import ObservationConfig
from damian.world.config import ActionConfig

# Specs and TorchRL's rules.


@pytest.mark.parametrize(
    ("motion", "belief"),
    [
        ("instant", []),
        ("polynomial", ["belief_moments"]),
    ],
)
def test_a_world_that_skips_steps_goes_on_as_if_they_had_not_been(motion, belief):
    delay = DelayConfig(
        obs={"law": "burst"},
        act="0..2",
        rew=1,
        history=2,
    )
    observation = ObservationConfig(LOCAL, GLOBAL, timeline=3, own=True, belief=belief)
    scenario = everything(motion, delay=delay, observation=observation)
    rounding = 1e-6 if belief else 0.0  # sums over cells in another order
    skipping, steady = (make_env(scenario, 2, seed=4) for _ in range(2))
    td = skipping.reset()
    other = steady.reset()
    for _ in range(6):
        action = random_actions(steady.base_env)
        after = steady.step(other.clone().set(ACTION, action))["next"]
        for world in (0, 1):  # first the one, then the other
            mask = torch.arange(2) == world
            stepped = skipping.step(td.clone().set(ACTION, action).set("_step", mask))["next"]
            assert same(stepped[world], after[world], rounding)
            assert same(
                stepped[1 - world].select(*td.keys(True, True), strict=False), td[1 - world]
            )
            td = stepped.select(*td.keys(True, True), strict=False)
        other = after.select(*other.keys(True, True), strict=False)


@pytest.mark.sample(6)
@pytest.mark.parametrize("region", REGIONS)
@both_kinds
@both_motions
@pytest.mark.parametrize("scenario", KINDS)
def test_the_specs_of_every_kind_of_scenario_are_right(scenario, motion, kind, region):
    config = ScenarioConfig(
        **KINDS[scenario],
        agents=2,
        region=REGIONS[region],
        motion=MOTIONS[motion],
        actions=ActionConfig(
            kind=kind,
            distances=[0.0, 60.0],
            headings=[0.0, 90.0, 180.0, 270.0],
        ),
    )
    check_env_specs(UavEnv(config, num_worlds=2), seed=0, break_when_any_done="both")


# Worlds and seeds.


def test_a_seed_repeats_its_episodes_and_worlds_and_episodes_differ():
    env = UavEnv(everything(), num_worlds=8)
    starts = []
    for seed in (7, 7, 8):
        env.set_seed(seed)
        starts.append(env.reset()["state"])
    assert starts[0].equal(starts[1])
    assert not starts[0].equal(starts[2])
    assert len(starts[0].unique(dim=0)) > 3
    assert not starts[2].equal(env.reset()["state"])


def test_a_reset_shows_the_same_if_its_tables_are_made_in_parts(monkeypatch):
    monkeypatch.setattr(uav_env, "_PAIRS_AT_ONCE", 10**9)
    whole = UavEnv(everything(), 2)
    monkeypatch.setattr(uav_env, "_PAIRS_AT_ONCE", 20)
    parts = UavEnv(everything(), 2)
    assert len(parts.simulation.initial.steps) > 20 // parts.n_agents**2
    for key, table in whole._reset_outputs.items():
        assert table.equal(parts._reset_outputs[key]), key
