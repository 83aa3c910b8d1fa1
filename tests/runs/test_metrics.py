"""Measures of episodes in evaluations and in training, and the files that hold them."""

import math
import time
from statistics import fmean

import pytest
import torch
from helpers import MOTIONS, both_motions, everything, square, walking
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensordict.nn import TensorDictModule
from torchrl.envs import RewardSum, StepCounter

from damian import BackupdateStorage, DelayConfig, keys, make_env
from damian.baselines.random import random_policy
from damian.envs.nodes import EpisodeTotals
from damian.envs.recompute import server_recompute
from damian.runs.checkpoint import plain
from damian.runs.metrics import EpisodeLog, HindsightReturns, evaluation
from damian.runs.metrics_log import MetricsLog, TensorBoard
from damian.server.config import EpisodeConfig, ObservationConfig, RewardConfig
from damian.world.config import SourceConfig
from damian.world.messages import Messages

HORIZON = 24
BURSTS = {
    "law": "burst",
    "enter": 0.3,
    "leave": 0.3,
    "good": 0,
    "bad": 5,
    "bad_loss": 0.2,
}
DELAYS = {
    "bursts and losses": DelayConfig(obs=BURSTS, loss=0.1),
    "rewards and actions too": DelayConfig(obs=2, act=1, rew=2),
}


def joint_spotting(motion, delay, **changed):
    """Two of three UAVs must spot the source at the same time; it is near many of the landing
    points."""
    sections = {
        "motion": MOTIONS[motion],
        # UAVs in flight hear nothing, so that a louder source is needed for as many successes.
        "source": SourceConfig(
            level_db=135.0 if motion == "instant" else 140.0, position=[100.0, 100.0]
        ),
        "delay": delay,
        "reward": RewardConfig(
            spotted=0.3, source_distance=0.2, bonus=2.0, bonus_over_steps=True, penalty=0.5
        ),
        "episode": EpisodeConfig(max_steps=20, success_share=0.6),
    }
    return square(**(sections | changed))


def fly(scenario, n_worlds=24):
    """A flight of the random policy, [B, HORIZON], and the server."""
    torch.manual_seed(1)
    env = make_env(scenario, n_worlds, seed=2, extras=["message"])
    return env.rollout(HORIZON, random_policy(env), break_when_any_done=False), env.server


POOLED = ("age", "late", "lost")
"""Measures that are means over all messages, not over episodes."""


def delays_by_hand(world, steps):
    """Ages of the messages held [steps], and whether each message sent is late or lost, in an
    episode."""
    agents = world["next", "agents"]
    delays = {"age": [], "late": [], "lost": []}
    for i in range(agents["message_sent"].shape[-1]):
        arrivals = {
            0: 0
        }  # step of arrival by step of generation; the first message arrives at once
        for t in range(1, steps + 1):
            if agents["message_sent"][t - 1, i]:
                delay = int(agents["delay"][t - 1, i]) if "delay" in agents else 0
                delays["late"].append(delay > 0)
                delays["lost"].append(delay == -1)
                arrivals |= {t: t + delay} if delay >= 0 else {}
            delays["age"].append(
                t - max(sent for sent, arrival in arrivals.items() if arrival <= t)
            )
    return delays


def episode_by_hand(world, server, needed):
    """Measures of the first episode of a flight [T], counted step by step."""
    row = {
        "perceived_return": 0.0,
        "return": 0.0,
        "perceived_success_rate": False,
        "success_rate": False,
    }
    row |= {"steps": HORIZON}
    truly_over = False
    for t in range(1, HORIZON + 1):
        next_step = world["next"][t - 1]
        row["perceived_return"] += next_step["agents", "reward"].mean().item()
        row["perceived_success_rate"] |= next_step["success"].item()
        truth = Messages.unpack(next_step["agents", "message"][None])
        steps = torch.tensor([t])
        if not truly_over:
            row["return"] += server(truth, steps).reward.mean().item()
        if truth.spotted.sum() >= needed and not truly_over:
            row["success_rate"] = truly_over = True
            row["steps"] = t
        if next_step["done"].item():
            break
    row["perceived_steps"] = t if row["perceived_success_rate"] else HORIZON
    return row | delays_by_hand(world, t)


def by_hand(flight, server, needed):
    """The measures of an ``Evaluation`` by name."""
    rows = [episode_by_hand(world, server, needed) for world in flight]
    found = {name: fmean(row[name] for row in rows) for name in rows[0] if name not in POOLED}
    pooled = {name: fmean(x for row in rows for x in row[name]) for name in POOLED}
    return found | pooled | {"episodes": len(rows)}


@pytest.mark.sample(2)
@both_motions
@pytest.mark.parametrize("delay", DELAYS)
def test_an_evaluation_equals_counting_step_by_step(motion, delay):
    flight, server = fly(joint_spotting(motion, DELAYS[delay]))
    expected = by_hand(flight, server, needed=2)
    assert evaluation(flight, server) == pytest.approx(expected, rel=1e-5)
    assert 0 < expected["perceived_success_rate"] <= 1
    assert 0 < expected["success_rate"] < 1


@both_motions
def test_without_delay_perceived_and_true_measures_are_equal_bit_for_bit(motion):
    ends = EpisodeConfig(max_steps=9, success_share=0.3, discharged_share=0.6, end_with_source=True)
    stops = everything(
        motion,
        episode=ends,
        source=walking(emission="per_step", after_walk="stop"),
    )
    for scenario in (joint_spotting(motion, DelayConfig()), stops):
        flight, server = fly(scenario)
        row = evaluation(flight, server)
        assert (row["success_rate"], row["steps"], row["return"]) == (
            row["perceived_success_rate"],
            row["perceived_steps"],
            row["perceived_return"],
        )
        assert (row["late"], row["lost"]) == (0.0, 0.0)
        assert (row["age"] == 0) == (motion == "instant")


@both_motions
def test_the_truth_of_a_term_that_reads_the_belief_is_the_belief_from_messages_on_time(motion):
    sections = {
        "observation": ObservationConfig(belief=["belief_moments"]),
        "reward": RewardConfig(
            spotted=0.3, custom=[{"term": "extensions:certainty", "weight": 1.0}]
        ),
        "episode": EpisodeConfig(max_steps=20),
    }
    flight, server = fly(joint_spotting(motion, DelayConfig(obs=BURSTS, loss=0.1), **sections))
    actions = iter(flight[keys.ACTION].unbind(1))
    again = TensorDictModule(lambda _: next(actions), [keys.READY], [keys.ACTION])
    env = make_env(
        joint_spotting(motion, DelayConfig(), **sections), 24, seed=2, extras=["message"]
    )
    same = env.rollout(HORIZON, again, break_when_any_done=False)
    late = evaluation(flight, server)
    on_time = evaluation(same, env.server)
    assert (
        on_time["return"] == on_time["perceived_return"] == pytest.approx(late["return"], rel=1e-6)
    )
    assert late["perceived_return"] != pytest.approx(late["return"], rel=0.01)


# Measures in training.


def training_batch():
    env = make_env(
        joint_spotting(
            "instant", DelayConfig(), episode=EpisodeConfig(max_steps=7, success_share=0.6)
        ),
        16,
    )
    env.append_transform(RewardSum([("agents", "reward")], [("agents", "episode_reward")]))
    env.append_transform(StepCounter())
    torch.manual_seed(4)
    return env.rollout(40, random_policy(env), break_when_any_done=False)


def ended_episodes(world):
    """Return, success and steps of each ended episode of a world [T]."""
    total = 0.0
    steps = 0
    ended = []
    for step in world["next"]:
        total += step["agents", "reward"].mean().item()
        steps += 1
        if step["done"]:
            ended.append(
                dict(zip(EpisodeLog.NAMES, (total, float(step["success"]), steps), strict=True))
            )
            total = 0.0
            steps = 0
    return ended


def test_the_episode_log_means_the_latest_episodes_of_each_world_and_begins_when_all_have_one(
    monkeypatch,
):
    monkeypatch.setattr(EpisodeLog, "EPISODES", 3 * len(batch := training_batch()))
    log = EpisodeLog(len(batch))
    for part in batch.split(3, 1):  # in some parts no episode ends
        state = log.state_dict()
        log = EpisodeLog(len(batch))
        log.load_state_dict(state)
        log.add(part)
    ended = [ended_episodes(world) for world in batch]
    latest = [episodes[-3:] for episodes in ended]
    assert log.finished == sum(map(len, ended)) > 50
    means = log.means()
    assert means.pop("hindsight_return") == means["perceived_return"]  # nothing is late
    for name, mean in means.items():
        assert mean == pytest.approx(
            fmean([fmean([row[name] for row in world]) for world in latest])
        )
    assert {row["perceived_success_rate"] for world in latest for row in world} == {0.0, 1.0}

    log = EpisodeLog(len(batch))
    shortest = min(int(world["next", "done"].int().argmax()) for world in batch)
    log.add(batch[:, : shortest + 1])
    assert log.finished > 0
    assert all(math.isnan(mean) for mean in log.means().values())


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_returns_in_hindsight_count_all_that_arrives_and_are_the_true_ones_if_nothing_is_lost(loss):
    late = DelayConfig(
        obs="1..4",
        loss=loss,
    )
    env = make_env(square(delay=late, episode=EpisodeConfig(max_steps=7)), 3, extras=["message"])
    server = env.server
    env.append_transform(EpisodeTotals())
    torch.manual_seed(0)
    data = env.rollout(44, break_when_any_done=False)

    def make():
        return HindsightReturns(BackupdateStorage(72, server_recompute(server, ["reward"]), 4), 2)

    measured = make()
    found = []
    for part in data.split([13, 1, 2, 28], 1):
        state = measured.state_dict()
        measured = make()
        measured.load_state_dict(plain(state))
        ended = measured.add(part)
        found.append(ended)
    found = torch.cat(found, 1)
    steps = data["next"]
    assert found.shape == (2, 44 - 4)
    for world in range(2):
        total = 0.0
        newest = data[keys.MESSAGE][world, 0].clone()
        for t in range(found.shape[1]):
            if t and steps[keys.DONE][world, t - 1]:
                total = 0.0
                newest = data[keys.MESSAGE][world, t].clone()
            arrives = steps[keys.DELAY][world, t, :, 0] >= 0
            newest[arrives] = steps[keys.MESSAGE][world, t][arrives]
            messages = server.messages(newest.unsqueeze(0))
            total += server(messages, steps[keys.STEP_COUNT][world, t]).reward.mean().item()
            if steps[keys.DONE][world, t]:
                assert found[world, t].item() == pytest.approx(total, abs=1e-5)
            else:
                assert found[world, t].isnan()
    assert (found.isnan().logical_not().sum(1) == 5).all()


def test_tensorboard_shows_numbers_up_to_where_a_run_resumed(tmp_path):
    for resumed, frames in ((0, [10, 20]), (10, [20, 30])):
        time.sleep(resumed / 10)  # files are in the order of the seconds in their names
        log = MetricsLog(tmp_path, to_csv=False, loggers=[TensorBoard(tmp_path, resumed)])
        for each in frames:
            log.add(each, {"loss": float(each + resumed)})
        log.close()
    events = EventAccumulator(str(tmp_path)).Reload().Scalars("train/loss")
    assert [(each.step, each.value) for each in events] == [(10, 10), (20, 30), (30, 40)]
