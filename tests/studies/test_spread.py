"""The study ``spread``: what late agents observe, what their critics learn from, and the command line."""

import csv
import json

import pytest
import spread
import torch
from simple_spread import AGES, DELAYS, DIRECTIONS, HELD, HORIZON, KINEMATICS, SEEN
from spread import ARMS, EVALUATED, LATE, LATEST, TRAINED, main, make_env, make_learner
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from damian import keys
from damian.learners.networks import ModelConfig

WORLDS = 3
TINY = ["--seeds", "4", "--frames", "1", "--episodes", "2"]


@pytest.fixture(scope="module")
def steps() -> TensorDictBase:
    """Two episodes of the arm ``learnt``, whose agents act at random, [T, B]."""
    torch.manual_seed(0)
    env = make_env(ARMS["learnt"], WORLDS, LATE)
    env.set_seed(0)
    return env.rollout(2 * HORIZON, break_when_any_done=False).transpose(0, 1)


def sent(steps: TensorDictBase, t: int) -> tuple[Tensor, Tensor]:
    """Messages [B, 15, 2] and delays [B, 15] of the ``t``-th observation of the first episode."""
    if t == 0:
        return steps[SEEN][0], torch.zeros(WORLDS, 15, dtype=torch.long)
    return steps["next", *SEEN][t - 1], steps["next", *DELAYS][t - 1].squeeze(-1)


def newest(steps: TensorDictBase, t: int, world: int, block: int) -> int:
    """When the newest message of a block was sent that has arrived by the ``t``-th observation."""
    arrived = [g for g in range(t + 1) if g + int(sent(steps, g)[1][world, block]) <= t]
    return max(arrived)


def at(steps: TensorDictBase, t: int, key) -> Tensor:
    """An entry of the ``t``-th observation of the first episode."""
    return steps[key][t] if t < HORIZON else steps["next", *key][t - 1]


def test_each_block_is_late_by_itself_and_agents_begin_with_what_they_see_at_the_beginning(steps):
    for t in range(HORIZON + 1):
        for world in range(WORLDS):
            for block in range(15):
                g = newest(steps, t, world, block)
                assert at(steps, t, HELD)[world, block].equal(sent(steps, g)[0][world, block])
                assert at(steps, t, AGES)[world, block] == t - g
    assert steps[HELD][HORIZON].equal(steps[SEEN][HORIZON])  # the next episode
    delays = steps["next", *DELAYS]
    assert delays.unique().tolist() == [3, 4, 5, 6, 7, 8, 9]
    assert (delays != delays[:, :, :1]).any()
    assert steps["next", *keys.DELAY].squeeze(-1).equal(delays.view(-1, WORLDS, 3, 5).amax(-1))


def test_an_aware_agent_observes_itself_at_once_and_others_late_with_ages_and_its_own_actions(steps):
    codes = 0.2 * torch.tensor(DIRECTIONS)  # 5 * 0.1 speed, of which 3/4 are left in each step of 0.1
    for t in range(HORIZON + 1):
        for agent in range(3):
            held, ages = (at(steps, t, key).unflatten(1, (3, 5))[:, agent] for key in (HELD, AGES))
            which = torch.eye(3)[agent].expand(WORLDS, 3)
            known = torch.cat([at(steps, t, KINEMATICS)[:, agent], held.flatten(1), which], 1)
            actions = [
                codes[steps[keys.ACTION][g, :, agent]] if g >= 0 else torch.zeros(WORLDS, 2)
                for g in range(t - LATEST, t)
            ]
            aware = torch.cat([known, ages.flatten(1) / LATEST, *actions], 1)
            torch.testing.assert_close(at(steps, t, keys.OBSERVATION)[:, agent], aware)
            assert at(steps, t, keys.GLOBAL_OBSERVATION)[:, agent].equal(known)


def test_the_learnt_belief_reads_every_block_of_the_latest_steps_that_has_arrived(steps):
    n_steps = ARMS["learnt"].messages
    for t in (0, 4, 13, HORIZON):
        found = at(steps, t, keys.HISTORY).view(WORLDS, 3, 5, n_steps, -1)
        for world in range(WORLDS):
            for block in range(15):
                for age in range(n_steps):
                    row, g = found[world, block // 5, block % 5, age], t - age
                    came = g >= 0 and g + int(sent(steps, g)[1][world, block]) <= t
                    place = sent(steps, g)[0][world, block] if came else torch.zeros(2)
                    assert row[:2].equal(place)
                    assert row[2:7].equal(torch.eye(5)[block % 5])
                    assert row[7] == came


@pytest.mark.parametrize("arm", [name for name, arm in ARMS.items() if arm])
def test_the_specs_hold_in_every_arm(arm):
    check_env_specs(make_env(ARMS[arm], 2, LATE))


@pytest.fixture
def small(monkeypatch) -> None:
    """Few worlds and small networks."""
    monkeypatch.setattr(spread, "WORLDS", 4)
    monkeypatch.setattr(spread, "MODEL", ModelConfig(hidden=[8]))
    monkeypatch.setattr(spread, "BELIEF", {"prediction_steps": 1, "prediction_batch": 8})


@pytest.mark.parametrize("arm", ["backupdate", "learnt"])
def test_critics_learn_from_what_agents_would_have_seen_without_delay(small, arm):
    env = make_env(ARMS[arm], 4, LATE)
    env.set_seed(0)
    learner = make_learner(env, ARMS[arm], 1)
    with torch.no_grad():
        batches = env.rollout(3 * HORIZON, learner.actor, break_when_any_done=False).split(HORIZON, 1)
    learner.backupdated_batch(batches[0])
    for batch in batches[1:]:
        late = learner.backupdated_batch(batch)
        seen = late["next", *SEEN].view(4, HORIZON, 3, 10)
        undelayed = torch.cat([late["next", *KINEMATICS], seen, torch.eye(3).expand(4, HORIZON, 3, 3)], -1)
        assert late["next", *keys.GLOBAL_OBSERVATION].equal(undelayed)
        assert not late["next", *keys.OBSERVATION][..., :17].equal(undelayed)
        assert late["next", *keys.BACKUPDATED].any()


@pytest.mark.parametrize("arm", [name for name, arm in ARMS.items() if arm])
def test_every_arm_learns(small, arm):
    env = make_env(ARMS[arm], 4, LATE)
    learner = make_learner(env, ARMS[arm], 1)
    before = [weights.clone() for weights in learner.actor.parameters()]
    with torch.no_grad():
        batches = env.rollout(2 * HORIZON, learner.actor, break_when_any_done=False).split(HORIZON, 1)
    numbers = [learner.learn(batch) for batch in batches][-1]
    assert numbers.get("backupdated", 1) > 0
    assert any(not old.equal(new) for old, new in zip(before, learner.actor.parameters(), strict=True))


# The command line.


def test_every_arm_and_seed_is_trained_once_and_gets_its_rows(small, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(spread, "EVALUATED", {"0": EVALUATED["0"], TRAINED: LATE})
    words = [*TINY, "--arms", "random", "naive", "--out", str(tmp_path)]
    main(words)
    with (tmp_path / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    arms = ["random", "naive"]
    assert [(row["arm"], row["delay"], row["seed"]) for row in rows] == [
        (arm, delay, "4") for arm in arms for delay in ("0", TRAINED)
    ]
    for row in rows:
        saved = json.loads((tmp_path / f"seed4_{row['arm']}.json").read_text())["returns"][row["delay"]]
        assert [row[name] for name in spread.ACTING] == [f"{saved[name]:.2f}" for name in spread.ACTING]
    text = (tmp_path / "table.md").read_text()
    assert text in capsys.readouterr().out
    assert "| undelayed, published | -33.1 | -37.6 | -48.8 | -59.9 | -67.2 |" in text
    files = [tmp_path / f"seed4_{arm}.json" for arm in arms]
    before, old = files[0].stat().st_mtime_ns, files[1].read_text()
    files[1].unlink()
    main(words)
    assert files[0].stat().st_mtime_ns == before
    assert files[1].read_text() == old  # the same run again
    with pytest.raises(SystemExit, match="has other settings"):
        main([*words, "--frames", "2"])


def test_the_table_has_means_ranges_and_recoveries(tmp_path):
    words = ["--arms", "undelayed", "naive", "history", "--seeds", "0", "1", "--out", str(tmp_path)]
    returns = {"undelayed": (-30.0, -34.0), "naive": (-50.0, -54.0), "history": (-36.0, -38.0)}
    for arm, values in returns.items():
        for seed, value in enumerate(values):
            each = {delay: dict.fromkeys(spread.ACTING, value) for delay in EVALUATED}
            saved = {"settings": {"frames": 1_000_000, "episodes": 1000}, "returns": each}
            (tmp_path / f"seed{seed}_{arm}.json").write_text(json.dumps(saved))
    main(words)
    text = (tmp_path / "table.md").read_text()
    cell = "-37.0 (-38.0, -36.0)"
    assert f"| history | {' | '.join([cell] * len(EVALUATED))} | 75% |" in text
    assert "| naive | -52.0 (-54.0, -50.0) |" in text


@pytest.mark.slow
def test_a_policy_learns_and_a_delay_lowers_its_return(tmp_path):
    words = ["--arms", "random", "undelayed", "--seeds", "0", "--frames", "300000", "--jobs", "2"]
    main([*words, "--out", str(tmp_path)])
    returns = json.loads((tmp_path / "seed0_undelayed.json").read_text())["returns"]
    assert returns["0"]["deterministic"] > -60  # of random actions: -80
    assert returns["12"]["deterministic"] < returns["0"]["deterministic"] - 10
