"""The oracle recipe: observations of UAVs that know some messages on time, and its table."""

import csv
import sys
from itertools import pairwise

import pytest
import torch
from helpers import both_motions, everything
from torchrl.envs import StepCounter

from damian import keys
from damian.common.errors import InputError
from damian.delays.config import DelayConfig
from damian.envs.pipeline import make_env
from damian.envs.scenario import ScenarioConfig
from damian.recipes import oracle, train
from damian.recipes.cli import settings as composed_config
from damian.server.features import ObservationConfig
from damian.world.messages import Messages
from damian.world.regions.config import RegionConfig
from damian.world.signal_source import SourceConfig

TINY = ["frames=64", "worlds=4", "learner.steps=16", "eval_episodes=4", "model.hidden=[8]", "logger=csv"]
TINY += ["region.lattice_step=60", "episode.max_steps=12"]  # quick to rank and to evaluate
FEATURES = slice(None, -4)  # the last four entries are the two past actions


def fly_delayed(motion, own=False):
    """A rollout [B, T] under delay, with two past actions in the observations, and its server."""
    delay = DelayConfig(obs={"law": "uniform", "low": 0, "high": 4}, history=2)
    scenario = everything(motion, delay=delay)
    scenario.observation.own = own
    env = make_env(scenario, 4, seed=3, extras=["message"])
    env.append_transform(StepCounter())
    torch.manual_seed(1)
    return env.rollout(15, break_when_any_done=False), env.server


def timely_observation(rollout, server, on_time, fields=oracle.ALL):
    """Observations with some messages known on time, after every step of a rollout [B, T], [B * T, N, F]."""
    steps = rollout["next"].select(("agents", "received"), ("agents", "message"), ("agents", "observation"))
    steps["step_count"] = rollout["next", "step_count"]
    observe = oracle.observe_with_timely_messages(server, on_time, fields)
    return observe(steps.reshape(-1))["agents", "observation"]


@both_motions
def test_no_message_on_time_changes_nothing_and_all_messages_on_time_give_the_true_features(motion):
    rollout, server = fly_delayed(motion)
    everybody = torch.ones(3, 3, dtype=torch.bool)
    delayed = rollout["next", "agents", "observation"].flatten(0, 1)
    assert timely_observation(rollout, server, ~everybody).equal(delayed)
    sent = Messages.unpack(rollout["next", "agents", "message"].flatten(0, 1))
    expected = server(sent, rollout["next", "step_count"].flatten()).observation
    assert timely_observation(rollout, server, everybody)[..., FEATURES].equal(expected)
    assert not expected.equal(delayed[..., FEATURES])


@both_motions
@pytest.mark.parametrize("fields", [oracle.ALL, oracle.PLACE])
def test_own_messages_on_time_give_the_same_observations_as_a_loop_over_uavs(motion, fields):
    rollout, server = fly_delayed(motion)
    after = rollout["next"].flatten(0, 1)
    observation = timely_observation(rollout, server, torch.eye(3, dtype=torch.bool), fields)
    for uav in range(3):
        held, sent = (Messages.unpack(after["agents", key].clone()) for key in ("received", "message"))
        for name in fields:
            getattr(held, name)[:, uav] = getattr(sent, name)[:, uav]
        expected = server(held, after["step_count"].view(-1)).observation
        assert observation[:, uav, FEATURES].equal(expected[:, uav])
    assert observation[..., -4:].equal(after["agents", "observation"][..., -4:])


@both_motions
def test_observation_own_is_the_oracle_that_knows_its_own_messages_on_time(motion):
    late, server = fly_delayed(motion)
    own_on_time, _ = fly_delayed(motion, own=True)
    assert own_on_time["agents", "action"].equal(late["agents", "action"])
    own = torch.eye(3, dtype=torch.bool)
    observation = own_on_time["next", "agents", "observation"].flatten(0, 1)[..., FEATURES]
    assert observation.equal(timely_observation(late, server, own)[..., FEATURES])
    assert not observation.equal(late["next", "agents", "observation"].flatten(0, 1)[..., FEATURES])
    for key in ("global_observation", "reward"):  # the server holds no other messages than before
        assert own_on_time["next", "agents", key].equal(late["next", "agents", key])


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("delay.obs=0", "delay.obs: no message is late or lost"),
        ("links=matrix", "links: matrix is not supported"),
        ("delay.messages=2", "follows from more messages than the latest ones"),
    ],
)
def test_rows_that_could_not_differ_or_not_be_computed_are_refused(word, message):
    with pytest.raises(InputError, match=message):
        oracle.check(composed_config("delay.obs=2", "checkpoint=trained", word))


def test_a_policy_that_knows_more_on_time_is_flown_too(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for program, words in (
        (train, [*TINY, "delay.obs=2", "hydra.run.dir=trained"]),
        (oracle, ["checkpoint=trained", "hydra.run.dir=oracle"]),
    ):
        monkeypatch.setattr(sys, "argv", ["recipe.py", *words])
        program.run()
    rows = (tmp_path / "oracle" / "result.md").read_text().split("\n\n")[0].splitlines()[2:]
    known = ["nothing", "where it is", "its own messages", "the others' messages", "everything"]
    assert [line.split(" | ")[0][2:] for line in rows] == known


# The script.

WORDS = ["scenario=delaybench/tracking", "observation.belief_cell=60", "eval_episodes=300"]
WORDS += ["episode.max_steps=25", "delay.obs=6", "hydra.run.dir=script"]


@pytest.fixture
def returns(tmp_path, monkeypatch):
    """The true return of every row of the recipe's table."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["damian oracle", *WORDS])
    oracle.run()
    with (tmp_path / "script/result.csv").open(newline="") as file:
        return {row["policy"]: float(row["return"]) for row in csv.DictReader(file)}


def test_who_knows_more_on_time_wins_more(returns):
    rows = ["what has arrived", "its own messages", "all messages", "the source's place"]
    assert [*returns] == rows
    for less, more in pairwise(rows):
        assert returns[less] < returns[more], (less, more)


def test_the_true_belief_is_certain_of_the_cell_with_the_nearest_centre():
    scenario = ScenarioConfig(
        region=RegionConfig(kind="random", pool=3, lattice_step=40),
        source=SourceConfig(motion="dynamic"),
        observation=ObservationConfig(belief=["belief_moments"]),
    )
    env = make_env(scenario, 12, seed=0, extras=["message", "state"])
    steps = env.rollout(5, break_when_any_done=False)[:, -1]
    grid = env.server.grid
    belief = oracle.true_belief(env)(steps.clone())[keys.BELIEF]
    assert torch.equal(belief.sum(-1), torch.ones(12))
    region = env.server.region_of(env.server.messages(steps[keys.MESSAGE]))
    for world in range(12):
        cells = [k for k in range(belief.shape[-1]) if grid.prior[region[world], k] > 0]
        east, north = steps[keys.STATE][world, -2:].tolist()
        nearest = min(
            cells, key=lambda k: (grid.centres[k, 0] - east) ** 2 + (grid.centres[k, 1] - north) ** 2
        )
        assert belief[world].argmax() == nearest
