"""The oracle: what each UAV would be told if some of the messages were on time."""

import sys

import oracle
import pytest
import torch
import train
from helpers import both_motions, everything
from shared.launch import launch
from torchrl.envs import StepCounter

from damian.delays.config import DelayConfig
from damian.envs.pipeline import make_env
from damian.world.messages import Messages

TINY = ["frames=64", "worlds=4", "learner.steps=16", "eval_episodes=4", "model.hidden=[8]", "logger=csv"]
N_FEATURES = slice(None, -4)  # two past actions stand behind


def flown(motion, own=False):
    """A flight under delay [B, T] with two past actions behind what is seen, and its server."""
    late = DelayConfig(obs={"law": "uniform", "low": 0, "high": 4}, history=2)
    scenario = everything(motion, delay=late)
    scenario.observation.own = own
    env = make_env(scenario, 4, seed=3, extras=["message"])
    env.append_transform(StepCounter())
    torch.manual_seed(1)
    return env.rollout(15, break_when_any_done=False), env.server


def told(flight, server, on_time, fields=oracle.ALL):
    """What ``observe_with_timely_messages`` shows at every step but the first, [B, T, N, F]."""
    steps = flight["next"].select(("agents", "received"), ("agents", "message"), ("agents", "observation"))
    steps["step_count"] = flight["next", "step_count"]
    return oracle.observe_with_timely_messages(server, on_time, fields)(steps.reshape(-1))[
        "agents", "observation"
    ]


@both_motions
def test_nobodys_messages_on_time_change_nothing_and_everybodys_tell_all(motion):
    flight, server = flown(motion)
    everybody = torch.ones(3, 3, dtype=torch.bool)
    seen = flight["next", "agents", "observation"].flatten(0, 1)
    assert told(flight, server, ~everybody).equal(seen)
    truth = Messages.unpack(flight["next", "agents", "message"].flatten(0, 1))
    expected = server(truth, flight["next", "step_count"].flatten()).observation
    assert told(flight, server, everybody)[..., N_FEATURES].equal(expected)
    assert not expected.equal(seen[..., N_FEATURES])


@both_motions
@pytest.mark.parametrize("fields", [oracle.ALL, oracle.PLACE])
def test_each_uav_is_told_with_its_own_message_on_time_what_a_loop_over_uavs_says(motion, fields):
    flight, server = flown(motion)
    after = flight["next"].flatten(0, 1)
    shown = told(flight, server, torch.eye(3, dtype=torch.bool), fields)
    for uav in range(3):
        held, sent = (Messages.unpack(after["agents", key].clone()) for key in ("received", "message"))
        for name in fields:
            getattr(held, name)[:, uav] = getattr(sent, name)[:, uav]
        served = server(held, after["step_count"].view(-1))
        assert shown[:, uav, N_FEATURES].equal(served.observation[:, uav])
    assert shown[..., -4:].equal(after["agents", "observation"][..., -4:])


@both_motions
def test_a_uav_that_knows_its_own_messages_sees_them_at_once_and_all_else_as_late_as_before(motion):
    late, server = flown(motion)
    prompt, _ = flown(motion, own=True)
    assert prompt["agents", "action"].equal(late["agents", "action"])
    own = torch.eye(3, dtype=torch.bool)
    seen = prompt["next", "agents", "observation"].flatten(0, 1)
    assert seen[..., N_FEATURES].equal(told(late, server, own)[..., N_FEATURES])
    assert not seen[..., N_FEATURES].equal(
        late["next", "agents", "observation"].flatten(0, 1)[..., N_FEATURES]
    )
    for key in ("global_observation", "reward"):  # the server knows no more than before
        assert prompt["next", "agents", key].equal(late["next", "agents", key])


@pytest.fixture
def foresee(tmp_path, monkeypatch):
    """Train a little, then run the recipe on it with overrides; returns its run folder."""
    monkeypatch.chdir(tmp_path)

    def run(program, *words: str) -> None:
        monkeypatch.setattr(sys, "argv", ["recipe.py", *words])
        launch(program.main)

    run(train, *TINY, "delay.obs=2", "hydra.run.dir=trained")

    def run_recipe(*words: str):
        run(oracle, "checkpoint=trained", *words, "hydra.run.dir=told")
        return tmp_path / "told"

    return run_recipe


def test_a_person_reads_whose_lateness_costs_what(foresee, capsys):
    table = (foresee() / "result.md").read_text()
    assert [line.split(" | ")[0][2:] for line in table.splitlines()[2:]] == [
        "nothing",
        "where it is",
        "its own messages",
        "the others' messages",
        "everything",
    ]
    assert "what a UAV knows on time" in capsys.readouterr().out


def test_where_nothing_is_late_there_is_nothing_to_foresee(foresee, capsys, tmp_path):
    with pytest.raises(SystemExit) as stopped:
        foresee("delay=none")
    assert stopped.value.code == 2
    assert "delay.obs: nothing is late" in capsys.readouterr().err
    assert not (tmp_path / "told").exists()
