"""What is measured of episodes: of an evaluation, of training, and how it is written down."""

import csv
import math
from dataclasses import asdict
from typing import Any

import pytest
import torch
from helpers import MOTIONS, both_motions, everything, square
from tensordict import TensorDictBase
from torchrl.envs import RewardSum, StepCounter

from damian.baselines.random import random_policy
from damian.common.errors import InputError
from damian.delays.config import DelayConfig
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.envs.scenario import ScenarioConfig
from damian.evaluation.metrics import EpisodeLog, Evaluation, evaluate, evaluation
from damian.evaluation.run_folder import MetricsLog, read_metrics, results_table, save_results
from damian.server.rewards import RewardConfig
from damian.server.server import Server
from damian.server.termination import EpisodeConfig
from damian.world.messages import Messages

HORIZON = 24
BURSTS = {"law": "burst", "enter": 0.3, "leave": 0.3, "good": 0, "bad": 5, "bad_loss": 0.2}
DELAYS = {
    "none": DelayConfig(),
    "constant": DelayConfig(obs=3),
    "bursts and losses": DelayConfig(obs=BURSTS, loss=0.1),
    "losses only": DelayConfig(loss=0.3),
    "rewards and actions too": DelayConfig(obs=2, act=1, rew=2),
}


def together(motion: str, delay: DelayConfig, **changed: Any) -> ScenarioConfig:
    """Two of three UAVs must spot a source at once that many of the landing points are near."""
    sections = {
        "motion": MOTIONS[motion],
        "delay": delay,
        "reward": RewardConfig(
            spotted=0.3, source_distance=0.2, bonus=2.0, bonus_over_steps=True, penalty=0.5
        ),
        "episode": EpisodeConfig(max_steps=20, success_share=0.6),
    }
    return square(**(sections | changed))


def flown(scenario: ScenarioConfig, n_worlds: int = 24) -> tuple[TensorDictBase, Server]:
    """A flight of the random policy [B, HORIZON], and the server."""
    torch.manual_seed(1)
    env = make_env(scenario, n_worlds, seed=2, extras=["message"])
    return env.rollout(HORIZON, random_policy(env), break_when_any_done=False), env.server


def delays_by_hand(world: TensorDictBase, steps: int) -> dict[str, list[float]]:
    """Ages of what is held [steps], and of each message sent whether it is late or lost, in an episode."""
    agents, found = world["next", "agents"], {"age": [], "late": [], "lost": []}
    for i in range(agents["message_sent"].shape[-1]):
        sent = {0: 0}  # the first message is there at once: when each was sent, and when it arrives
        for t in range(1, steps + 1):
            if agents["message_sent"][t - 1, i]:
                delay = int(agents["delay"][t - 1, i]) if "delay" in agents else 0
                found["late"].append(delay > 0)
                found["lost"].append(delay == -1)
                sent |= {t: t + delay} if delay >= 0 else {}
            found["age"].append(t - max(at for at, arrives in sent.items() if arrives <= t))
    return found


def episode_by_hand(world: TensorDictBase, server: Server, needed: int) -> dict[str, Any]:
    """What the first episode of a flight [T] comes to, step by step."""
    row = {"episode_return": 0.0, "true_return": 0.0, "success": False, "true_success": False}
    row |= {"true_steps": HORIZON}
    truly_over = False
    for t in range(1, HORIZON + 1):
        after = world["next"][t - 1]
        row["episode_return"] += after["agents", "reward"].mean().item()
        row["success"] |= after["success"].item()
        truth, steps = Messages.unpack(after["agents", "message"][None]), torch.tensor([t])
        judged = server.reward_and_status(
            server.features(truth, steps), truth, steps, torch.zeros(1, dtype=torch.bool)
        )
        if not truly_over:
            row["true_return"] += judged.reward.mean().item()
        if truth.spotted.sum() >= needed and not truly_over:
            row["true_success"] = truly_over = True
            row["true_steps"] = t
        if after["done"].item():
            break
    row["steps"] = t if row["success"] else HORIZON
    return row | delays_by_hand(world, t)


def by_hand(flight: TensorDictBase, server: Server, needed: int) -> tuple[dict[str, float], list[dict]]:
    """The same measures as an ``Evaluation``, and each episode."""
    rows = [episode_by_hand(world, server, needed) for world in flight]

    def mean(name: str) -> float:
        return sum(row[name] for row in rows) / len(rows)

    def over_all(name: str) -> float:
        values = [value for row in rows for value in row[name]]
        return sum(values) / len(values)

    same = ("steps", "episode_return", "true_steps", "true_return")
    means = {
        "episodes": len(rows),
        "success_rate": mean("success"),
        "true_success_rate": mean("true_success"),
    }
    shares = {name: over_all(name) for name in ("age", "late", "lost")}
    return means | {name: mean(name) for name in same} | shares, rows


@both_motions
@pytest.mark.parametrize("delay", DELAYS)
def test_an_evaluation_is_what_counting_step_by_step_comes_to(motion, delay):
    flight, server = flown(together(motion, DELAYS[delay]))
    expected, _ = by_hand(flight, server, needed=2)
    assert asdict(evaluation(flight, server)) == pytest.approx(expected, rel=1e-5)
    assert 0 < expected["success_rate"] <= 1
    assert 0 < expected["true_success_rate"] < 1


@both_motions
def test_successes_that_never_truly_were_or_are_learnt_of_late_are_told_apart(motion):
    flight, server = flown(together(motion, DelayConfig(obs=BURSTS, loss=0.2)), 64)
    expected, rows = by_hand(flight, server, needed=2)
    false = [row for row in rows if row["success"] and not row["true_success"]]
    late = [row for row in rows if row["success"] and row["true_steps"] < row["steps"]]
    missed = [row for row in rows if row["true_success"] and not row["success"]]
    assert false
    assert late
    assert missed
    assert all(row["steps"] < row["true_steps"] == HORIZON for row in false)
    row = evaluation(flight, server)
    assert row.true_success_rate - row.success_rate == pytest.approx((len(missed) - len(false)) / 64)
    assert asdict(row) == pytest.approx(expected, rel=1e-5)


@both_motions
def test_without_delay_what_is_perceived_is_true_to_the_bit(motion):
    ends = EpisodeConfig(max_steps=9, success_share=0.3, discharged_share=0.6, end_with_source=True)
    for scenario in (together(motion, DelayConfig()), everything(motion, episode=ends)):
        flight, server = flown(scenario)
        row = evaluation(flight, server)
        assert (row.true_success_rate, row.true_steps, row.true_return) == (
            row.success_rate,
            row.steps,
            row.episode_return,
        )
        assert (row.late, row.lost) == (0.0, 0.0)
        assert (row.age == 0) == (motion == "instant")


def test_an_episode_that_nothing_ends_counts_the_horizon():
    persistent = together("instant", DELAYS["constant"], episode=EpisodeConfig(max_steps=None))
    row = evaluation(*flown(persistent))
    assert (row.steps, row.true_steps, row.success_rate, row.true_success_rate) == (HORIZON, HORIZON, 0, 0)


def test_an_evaluation_flies_as_long_as_it_is_told_and_draws_or_takes_the_mode():
    def env() -> DelayedEnv:
        return make_env(together("instant", DELAYS["constant"]), 8, seed=2, extras=["message"])

    policy = random_policy(env())
    torch.manual_seed(1)
    row = evaluate(env(), policy, 6)
    torch.manual_seed(1)
    flight = env().rollout(6, policy, break_when_any_done=False)
    assert row == evaluation(flight, env().server)
    assert row.steps <= 6


# While training.


def training_batch() -> TensorDictBase:
    env = make_env(
        together("instant", DelayConfig(), episode=EpisodeConfig(max_steps=7, success_share=0.6)), 16
    )
    env.append_transform(RewardSum([("agents", "reward")], [("agents", "episode_reward")]))
    env.append_transform(StepCounter())
    torch.manual_seed(4)
    return env.rollout(40, random_policy(env), break_when_any_done=False)


def ended_episodes(batch: TensorDictBase) -> list[dict[str, float]]:
    """Return, success and steps of each, in order of their ends."""
    running, found = [[0.0, 0] for _ in range(len(batch))], []
    for t in range(batch.shape[1]):
        for world, so_far in enumerate(running):
            after = batch["next"][world, t]
            so_far[0] += after["agents", "reward"].mean().item()
            so_far[1] += 1
            if after["done"]:
                won = float(after["success"])
                found.append({"episode_return": so_far[0], "success_rate": won, "steps": float(so_far[1])})
                running[world] = [0.0, 0]
    return found


@pytest.mark.parametrize("factor", [0.0, 0.9, 0.991])
def test_the_episode_log_is_an_exponential_mean_over_episodes_in_order_of_their_ends(factor):
    batch, log = training_batch(), EpisodeLog(factor)
    for part in batch.split([13, 1, 26], 1):
        log.add(part)
    episodes = ended_episodes(batch)
    assert log.finished == len(episodes) > 50
    for name, mean in log.means().items():
        weights = [factor**k for k in range(len(episodes))]
        weighed = [w * row[name] for w, row in zip(weights, reversed(episodes), strict=True)]
        assert mean == pytest.approx(sum(weighed) / sum(weights), rel=1e-5)
    assert {row["success_rate"] for row in episodes} == {0.0, 1.0}


def test_before_any_episode_has_ended_there_is_no_mean():
    log = EpisodeLog()
    log.add(training_batch()[:, :0])
    assert log.finished == 0
    assert all(math.isnan(mean) for mean in log.means().values())


def test_an_episode_log_goes_on_from_a_checkpoint():
    batch = training_batch()
    log, restored = EpisodeLog(0.9), EpisodeLog(0.9)
    log.add(batch[:, :20])
    restored.load_state_dict(log.state_dict())
    assert restored.means() == log.means()
    for one in (log, restored):
        one.add(batch[:, 20:])
    assert restored.means() == log.means()
    assert restored.finished == log.finished


# On paper.

ROW = Evaluation(4, 0.25, 50.0, 1.5, 0.75, 30.0, 2.5, 0.125, 0.5, 0.1)


def test_a_table_shows_success_and_the_truth_only_where_there_are_any():
    plain = results_table({"random": ROW}, can_succeed=False).splitlines()
    assert plain[0] == "| policy | return | episodes |"
    assert plain[2] == "| random | 1.50 | 4 |"
    task = results_table({"random": ROW}, can_succeed=True).splitlines()
    assert task[0] == "| policy | success rate | steps | return | episodes |"
    assert task[2] == "| random | 0.25 | 50.00 | 1.50 | 4 |"
    late = results_table({"random": ROW}, can_succeed=True, late=True).splitlines()
    assert late[2] == "| random | 0.25 | 50.00 | 1.50 | 0.75 | 30.00 | 2.50 | 0.12 | 0.50 | 0.10 | 4 |"
    assert late[0].count("true") == 3


def test_results_are_written_with_every_measure(tmp_path):
    table = save_results({"one": ROW, "other": ROW}, tmp_path, can_succeed=False, late=False)
    assert (tmp_path / "result.md").read_text() == table + "\n"
    with (tmp_path / "result.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row.pop("policy") for row in rows] == ["one", "other"]
    assert [{name: float(x) for name, x in row.items()} for row in rows] == [asdict(ROW)] * 2
    assert {path.name for path in tmp_path.iterdir()} == {"result.csv", "result.md"}


def test_a_spoilt_metrics_file_is_one_clear_line(tmp_path):
    log = MetricsLog(tmp_path, tensorboard=False, to_csv=True)
    log.add(10, {"steps": 2.0})
    assert read_metrics(tmp_path) == [{"frames": 10.0, "steps": 2.0}]
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write("20,many\n")
    with pytest.raises(InputError, match=r"metrics\.csv, line 3: not a row of numbers"):
        read_metrics(tmp_path)
