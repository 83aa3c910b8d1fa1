"""The pendulum recipe: SAC on Pendulum-v1 with the delay transforms, run by its command line."""

import csv
import json
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from torch import nn
from tqdm import tqdm

from damian import keys
from damian.common.errors import RUN_ERROR
from damian.learners.sac import Sac
from damian.recipes import pendulum
from damian.recipes.pendulum import ARMS, Run, draw, evaluate_under, main, make_env, make_learner, train
from damian.recipes.shared.outside_runs import file_of

TINY = ["--seeds", "4", "--steps", "1002", "--episodes", "2", "--hidden", "8", "--delay", "3"]


def learn(delay: int, history: int, steps: int, arm: str = "history") -> nn.Module:
    """The policy that is trained with one seed."""
    torch.manual_seed(0)
    env = make_env(delay, history)
    env.set_seed(0)
    learner = make_learner(env, Run(arm, 0, steps, delay, 20, 128))
    train(env, learner, steps, tqdm(disable=True))
    return learner.actor


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The run folder of a comparison that two processes have finished."""
    folder = tmp_path_factory.mktemp("pendulum")
    main([*TINY, "--out", str(folder), "--jobs", "2"])
    return folder


@pytest.mark.slow
def test_the_table_lists_every_arm_beside_its_reference(folder):
    with (folder / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    arms = [(row["arm"], row["delay"]) for row in rows]
    assert arms == [*(("undelayed", d) for d in "023468"), *((arm, "3") for arm in ARMS[1:])]
    assert [row["reference"] for row in rows] == ["-145", "-153", "-324", "-757", "-777", "-977", "", "", ""]
    for row in rows:
        saved = json.loads((folder / f"seed4_{row['arm']}.json").read_text())
        assert row["seed 4"] == row["mean"] == f"{saved['returns'][row['delay']]:.0f}"
        assert f"| {' | '.join(row.values())} |" in (folder / "results.md").read_text()


@pytest.mark.slow
def test_finished_arms_are_kept_and_a_missing_one_is_reproduced_by_another_process(folder, capsys):
    files = [folder / f"seed4_{arm}.json" for arm in ARMS]
    before = [(file.stat().st_mtime_ns, file.read_text()) for file in files]
    files[1].unlink()
    main([*TINY, "--out", str(folder)])
    assert (folder / "results.md").read_text() in capsys.readouterr().out
    after = [(file.stat().st_mtime_ns, file.read_text()) for file in files]
    assert after[0] == before[0]
    assert after[2:] == before[2:]
    assert after[1][0] > before[1][0]
    assert after[1][1] == before[1][1]
    assert not list(folder.glob("*.part"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--steps", "1000"], "--steps: 1000 is not between 1001 and 1e+08"),
        (["--delay", "0"], "--delay: 0 steps is not between 1 and 200 steps"),
        (["--seeds", "0,x"], "--seeds: 0,x is not a list of different whole numbers"),
        (["--seeds", "1,01"], "--seeds: 1,01 is not a list of different whole numbers"),
        (["--arms", "history,bqpl"], "--arms: history,bqpl is not a list of different ones of undelayed,"),
        (["--arms", "naive,naive"], "--arms: naive,naive is not a list of different ones of"),
        (["--jobs", "0"], "--jobs: 0 is not between 1 and 1024"),
        (["--episodes", "many"], "argument --episodes: invalid int value: 'many'"),
        (["--lag", "6"], "unrecognized arguments: --lag 6"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        main(words)
    error = capsys.readouterr().err
    assert stopped.value.code == 2
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_folder_with_results_of_other_settings_is_refused(tmp_path, capsys):
    runs, _, _ = pendulum.parse(TINY)
    file_of(runs[0], tmp_path).write_text(json.dumps({**runs[0]._asdict(), "delay": 6, "returns": {}}))
    with pytest.raises(SystemExit):
        main([*TINY, "--out", str(tmp_path)])
    assert "--delay: 3 is not the 6 of" in capsys.readouterr().err


def finished(folder: Path, arms: str) -> list[str]:
    """The words of a comparison of arms whose results a folder has already."""
    words = [*TINY, "--arms", arms, "--out", str(folder)]
    for run in pendulum.parse(words)[0]:
        file_of(run, folder).write_text(json.dumps({**run._asdict(), "returns": {"3": -10.0 * len(run.arm)}}))
    return words


def test_some_arms_only_have_a_table_of_their_own(tmp_path):
    main(finished(tmp_path, "bpql,naive"))
    with (tmp_path / "results.csv").open(newline="") as file:
        rows = [(row["arm"], row["mean"], row["seed 4"]) for row in csv.DictReader(file)]
    assert rows == [("bpql", "-40", "-40"), ("naive", "-50", "-50")]


def test_a_table_that_cannot_be_written_is_one_line(tmp_path, capsys):
    (tmp_path / "results.csv").mkdir()
    with pytest.raises(SystemExit) as stopped:
        main(finished(tmp_path, "naive"))
    error = capsys.readouterr().err
    assert stopped.value.code == RUN_ERROR
    assert error.startswith(f"error: {tmp_path}/results.csv: it cannot be written: Is a directory")
    assert error.count("\n") == 1


# What the learners of the arms read.

DELAY, STEPS = 3, 215  # an episode has 200 steps


def collected(arm: str, steps: int) -> Sac:
    """The learner of an arm after random actions."""
    torch.manual_seed(0)
    env = make_env(DELAY, DELAY)
    env.set_seed(0)
    learner = make_learner(env, Run(arm, 0, 1000, DELAY, 20, 8))
    train(env, learner, steps, tqdm(disable=True))
    return learner


def stored(learner: Sac) -> TensorDictBase:
    """The steps of its replay buffer, [T]."""
    storage = learner.buffer.storage
    return storage.steps[storage.latest(), 0]


@pytest.fixture(scope="module")
def steps() -> TensorDictBase:
    """What the arm bpql has stored by the last step, [STEPS]."""
    return stored(collected("bpql", STEPS))


def test_the_states_that_critics_of_bpql_read_are_the_undelayed_observations_that_have_arrived(steps):
    assert len(steps) == STEPS
    twin = make_env(0, 0)
    twin.set_seed(0)
    now = twin.reset()
    for step in range(STEPS):  # the same actions without delay
        now[keys.ACTION] = steps[keys.ACTION][step]
        undelayed, now = twin.step_and_maybe_reset(now)
        state = undelayed["next", *keys.OBSERVATION]
        if step < STEPS - DELAY:
            assert steps["next", *keys.GLOBAL_OBSERVATION][step].equal(state)
            assert steps[keys.GLOBAL_OBSERVATION][step].equal(undelayed[keys.OBSERVATION])
            newest = state
        else:  # the newest one that has arrived by the end
            assert steps["next", *keys.GLOBAL_OBSERVATION][step].equal(newest)
    late = steps["next", *keys.OBSERVATION][:, :3]
    assert not late.equal(steps["next", *keys.GLOBAL_OBSERVATION])


def test_the_actor_of_bpql_observes_what_has_arrived_and_its_own_actions_since(steps):
    for step in range(STEPS):
        begin = 200 if step >= 200 else 0
        held = steps[keys.GLOBAL_OBSERVATION][max(step - DELAY, begin)]  # the state then, by the test above
        since = [
            (steps[keys.ACTION][i] + 2) / 4 if i >= begin else torch.tensor([0.5])  # scaled to [0, 1]
            for i in range(step - DELAY, step)
        ]
        torch.testing.assert_close(steps[keys.OBSERVATION][step], torch.cat([held, *since]))


@pytest.mark.parametrize(("arm", "waits"), [("history", 0), ("bpql", DELAY)])
def test_bpql_alone_waits_until_the_observation_after_a_step_has_arrived(arm, waits):
    learner = collected(arm, 20)
    learner.buffer.storage.steps["next", *keys.REWARD][:20] = torch.arange(20.0).view(20, 1, 1)
    drawn = draw(learner)["next", *keys.REWARD].unique()
    assert drawn.tolist() == [*range(20 - waits)]
    read = {"history": keys.OBSERVATION, "bpql": keys.GLOBAL_OBSERVATION}[arm]
    assert learner.loss.qvalue_network.in_keys == [read, keys.ACTION]


def test_actions_are_drawn_from_the_policy_while_it_learns(monkeypatch):
    monkeypatch.setattr(pendulum, "RANDOM_STEPS", 2)
    monkeypatch.setattr(Sac, "update", lambda *_: None)
    actions = stored(collected("history", 12))[keys.ACTION][2:]
    # Its mode, which hardly differs between states before it has learnt, would explore nothing.
    assert actions.std() > 0.5


@pytest.mark.slow
def test_delay_lowers_the_return_and_the_action_history_restores_it():
    undelayed = learn(delay=0, history=0, steps=9_000)
    returns = {delay: evaluate_under(delay, 0, undelayed, 20) for delay in (0, 6)}
    assert returns[0] > -300
    assert returns[6] < returns[0] - 300
    naive = evaluate_under(6, 0, learn(delay=6, history=0, steps=12_000), 20)
    for arm, steps in (("history", 12_000), ("bpql", 8_000)):
        aware = evaluate_under(6, 6, learn(delay=6, history=6, steps=steps, arm=arm), 20)
        assert aware > naive + 300, arm
