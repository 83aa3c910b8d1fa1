"""Back-updating: late messages in their place, against a loop, and against the same flight undelayed."""

from dataclasses import replace

import pytest
import torch
from helpers import everything, random_actions, square
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import SamplerWithoutReplacement, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import StepCounter

from damian.delays.config import DelayConfig
from damian.envs.pipeline import make_env
from damian.envs.scenario import ScenarioConfig
from damian.envs.uav_env import EXTRAS
from damian.replay.backupdate import BackupdateStorage
from damian.replay.hindsight import MessageLog, ended_before, latest_arrived
from damian.replay.recompute import server_recompute
from damian.server.termination import EpisodeConfig
from damian.world.messages import Messages

LONGEST = 5
LATE = {"law": "uniform", "low": 0, "high": LONGEST}
WORLDS, UAVS = 3, 2


# The pure function, against a loop.


def mail(n_steps: int, loss: float, order: str, generator: torch.Generator) -> tuple[MessageLog, Tensor]:
    """Random messages that say when they were sent, what is held of them, and where episodes begin."""

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    begins = rand(n_steps, WORLDS, 1).expand(-1, -1, UAVS) < 0.15
    begins[0] = True
    delay = (rand(n_steps, WORLDS, UAVS) * (LONGEST + 1)).long()
    delay[rand(*delay.shape) < loss] = -1
    sent = torch.arange(n_steps).view(-1, 1, 1).expand(delay.shape)
    held = torch.zeros_like(sent)
    for b in range(WORLDS):
        for i in range(UAVS):
            for t in range(n_steps):
                start = max(s for s in range(t + 1) if begins[s, b, i])
                came = [g for g in range(start, t + 1) if 0 <= delay[g, b, i] <= t - g]
                latest = [g for g in came if g + delay[g, b, i] == max(h + delay[h, b, i] for h in came)]
                held[t, b, i] = max((came if order == "generation" else latest), default=start - 1)
    return MessageLog(sent.unsqueeze(-1).float(), delay, held.unsqueeze(-1).float(), sent - held), begins


@pytest.mark.parametrize("order", ["generation", "arrival"])
@pytest.mark.parametrize("loss", [0.0, 0.5])
def test_hindsight_does_what_a_loop_over_messages_does(loss, order):
    generator = torch.Generator().manual_seed(1)
    for _ in range(20):
        given, begins = mail(16, loss, order, generator)
        now = int(torch.randint(16, (), generator=generator))
        known = latest_arrived(given, now)[..., 0]
        for b in range(WORLDS):
            for i in range(UAVS):
                for t in range(now + 1):
                    start = max(s for s in range(t + 1) if begins[s, b, i])
                    came = [g for g in range(start, t + 1) if 0 <= given.delay[g, b, i] <= now - g]
                    assert known[t, b, i] == max(came, default=start - 1)


def test_nothing_that_arrives_after_the_learning_instant_is_used():
    given, _ = mail(16, 0.2, "generation", torch.Generator().manual_seed(2))
    now = 9
    arrives = torch.arange(16).view(-1, 1, 1) + given.delay
    later = (arrives > now) | (torch.arange(16).view(-1, 1, 1) > now)
    spoilt = given._replace(sent=torch.where(later.unsqueeze(-1), torch.nan, given.sent))
    assert later[: now + 1].any()
    assert latest_arrived(spoilt, now)[: now + 1].equal(latest_arrived(given, now)[: now + 1])


def test_an_episode_is_over_after_its_first_end():
    def column(*flags: int) -> Tensor:
        return torch.tensor(flags, dtype=torch.bool).unsqueeze(-1)

    ended, begins = column(0, 1, 0, 1, 0, 0, 1), column(1, 0, 0, 0, 1, 0, 0)
    assert ended_before(ended, begins, torch.zeros(1).bool()).equal(column(0, 0, 1, 1, 0, 0, 0))
    begins[0] = False
    assert ended_before(ended, begins, torch.ones(1).bool()).equal(column(1, 1, 1, 1, 0, 0, 0))


# The storage, on flights.


def flight(scenario: ScenarioConfig, n_steps: int, n_worlds: int = 4) -> TensorDictBase:
    """Steps [B, T] of random actions, the same at each call."""
    env = make_env(scenario, n_worlds, extras=EXTRAS)
    env.append_transform(StepCounter())
    generator = torch.Generator().manual_seed(5)
    td, steps = env.reset(), []
    for _ in range(n_steps):
        stepped, td = env.step_and_maybe_reset(
            td.set(("agents", "action"), random_actions(env.base_env, generator))
        )
        steps.append(stepped.clone())
    return torch.stack(steps, 1)


def buffer(
    scenario: ScenarioConfig, capacity: int, n_worlds: int = 4, actor: bool = False, **options
) -> TensorDictReplayBuffer:
    env = make_env(scenario, n_worlds)
    view = server_recompute(env.base_env.server, reward_terms=True, actor=actor)
    storage = BackupdateStorage(capacity * n_worlds, view, LONGEST)
    return TensorDictReplayBuffer(storage=storage, batch_size=8, **options)


def in_order(stored: TensorDictReplayBuffer, n_steps: int) -> TensorDictBase:
    """The latest steps, [T, B]."""
    storage = stored.storage
    return storage[storage.latest(n_steps)]


PERSISTENT = EpisodeConfig(max_steps=None)
CORRECTED = [
    ("next", "agents", "global_observation"),
    ("next", "agents", "reward"),
    ("next", "agents", "reward_terms"),
    *[("next", name) for name in ("success", "done", "terminated", "truncated")],
    ("agents", "global_observation"),
]


def check_truth(known: TensorDictBase, truth: TensorDictBase) -> None:
    for key in CORRECTED:
        ours, theirs = known[key], truth[key]
        for name, value in theirs.items() if isinstance(theirs, TensorDictBase) else [("", theirs)]:
            assert (ours[name] if name else ours).equal(value), (key, name)


@pytest.mark.parametrize("motion", ["instant", "polynomial"])
@pytest.mark.parametrize("parts", [1, 3, 13])
def test_hindsight_is_truth_once_every_message_has_arrived(motion, parts):
    scenario = everything(motion, episode=PERSISTENT)
    undelayed = flight(scenario, 39)
    late = flight(replace(scenario, delay=DelayConfig(obs=LATE)), 39)
    stored = buffer(scenario, 64)
    for part in late.split(39 // parts, 1):
        stored.extend(part)
    known, truth = (td[: 39 - LONGEST] for td in (in_order(stored, 39), undelayed.transpose(0, 1)))
    assert not known["next", "agents", "received"].equal(truth["next", "agents", "message"])
    check_truth(known, truth)


@pytest.mark.parametrize("motion", ["instant", "polynomial"])
@pytest.mark.parametrize("ctde", [False, True])
def test_an_actor_may_be_shown_what_it_would_have_seen_without_delay_beside_what_it_remembers(motion, ctde):
    scenario = everything(motion, episode=PERSISTENT)
    scenario.observation.ctde = ctde
    undelayed = flight(replace(scenario, delay=DelayConfig(history=2)), 39)
    late = flight(replace(scenario, delay=DelayConfig(obs=LATE, history=2)), 39)
    stored = buffer(scenario, 64, actor=True)
    for part in late.split(13, 1):
        stored.extend(part)
    known, truth, perceived = (
        td[: 39 - LONGEST] for td in (in_order(stored, 39), undelayed.transpose(0, 1), late.transpose(0, 1))
    )
    for key in (("agents", "observation"), ("next", "agents", "observation")):
        told, true, held = (td[key][..., : -2 * 2] for td in (known, truth, perceived))
        assert not held.equal(true)
        assert told.equal(true)
    n_told = len(scenario.observation.actor)
    remembered = late["agents", "observation"].transpose(0, 1)[..., -2 * 2 :]
    assert remembered.any()
    assert in_order(stored, 39)["agents", "observation"][..., -2 * 2 :].equal(remembered)
    assert known["agents", "observation"].shape[-1] >= n_told + 2 * 2


@pytest.mark.parametrize("order", ["generation", "arrival"])
@pytest.mark.parametrize("motion", ["instant", "polynomial"])
def test_backupdated_is_where_something_newer_than_what_was_held_came_late(motion, order):
    scenario = everything(motion, episode=EpisodeConfig(max_steps=9))
    late = flight(replace(scenario, delay=DelayConfig(obs=LATE, loss=0.2, order=order)), 40)
    stored = buffer(scenario, 64)
    for part in late.split(8, 1):
        stored.extend(part)
    flags = in_order(stored, 40)["agents", "backupdated"].squeeze(-1)
    delay = late["next", "agents", "delay"].squeeze(-1)
    held = Messages.unpack(late["next", "agents", "received"]).time
    step_count, expected = late["step_count"].squeeze(-1), torch.zeros_like(flags)
    for b in range(4):
        for t in range(40):
            start = t - int(step_count[b, t])
            for i in range(flags.shape[-1]):
                came = [g for g in range(start, t + 1) if 0 <= delay[b, g, i] <= 39 - g]
                newest = max((g - start + 1 for g in came), default=0)
                expected[t, b, i] = newest > held[b, t, i]
    assert 0.05 < expected.float().mean() < 0.95
    assert flags.equal(expected)


@pytest.mark.parametrize("order", ["generation", "arrival"])
def test_in_pieces_and_around_the_ring_the_same_is_known_as_at_once(order):
    scenario = everything("instant", episode=EpisodeConfig(max_steps=7))
    delay = DelayConfig(obs={"law": "burst", "bad": LONGEST, "bad_loss": 0.3}, loss=0.1, order=order)
    late = flight(replace(scenario, delay=delay), 60)
    whole, ring = buffer(scenario, 80), buffer(scenario, 25)
    whole.extend(late)
    for part in late.split(4, 1):
        ring.extend(part)
    n_final = 25 - 2 * LONGEST
    known, again = in_order(whole, n_final), in_order(ring, n_final)
    for key in known.keys(True, True):
        if key != "index":
            assert known[key].equal(again[key]), key


def test_messages_from_elsewhere_count_as_if_they_had_arrived_just_now():
    scenario = everything(delay=DelayConfig(obs=LATE, loss=0.4))
    steps, stored, expected = flight(scenario, 30), buffer(scenario, 60), buffer(scenario, 60)
    delay = steps["next", "agents", "delay"]
    lost = (delay[:, -LONGEST:] < 0).squeeze(-1).nonzero()
    world, agent, ago = lost[:, 0], lost[:, 2], LONGEST - 1 - lost[:, 1]
    assert len(lost) > 10
    came = steps.clone()
    came["next", "agents", "delay"][world, 29 - ago, agent, 0] = ago
    expected.extend(came)
    message = steps["next", "agents", "message"][world, 29 - ago, agent]
    steps["next", "agents", "message"][world, 29 - ago, agent] = 0.0  # nobody has heard them
    stored.extend(steps)
    with pytest.raises(AssertionError):
        check_truth(in_order(stored, 30), in_order(expected, 30))
    stored.storage.receive(world, agent, ago, message)
    check_truth(in_order(stored, 30), in_order(expected, 30))
    with pytest.raises(ValueError, match=f"steps_ago: 0 to {LONGEST + 1} is not between 0 and {LONGEST}"):
        stored.storage.receive(world[:2], agent[:2], torch.tensor([0, LONGEST + 1]), message[:2])


def test_what_the_actor_saw_and_did_stays():
    scenario = everything("instant", episode=EpisodeConfig(max_steps=9))
    late = flight(replace(scenario, delay=DelayConfig(obs=LATE, history=2)), 30)
    stored = buffer(scenario, 64)
    stored.extend(late)
    known = in_order(stored, 30).transpose(0, 1)
    changed = {key for key in late.keys(True, True) if not known[key].equal(late[key])}
    assert ("agents", "observation") not in changed
    assert ("agents", "action") not in changed
    assert ("next", "agents", "reward") in changed
    assert ("agents", "global_observation") in changed
    begins, seen = late["step_count"].squeeze(-1) == 0, ("agents", "global_observation")
    assert begins[:, 1:].any()
    assert known[seen][begins].equal(late[seen][begins])


def test_a_success_that_was_learnt_of_late_ends_the_episode_where_it_happened():
    scenario = square(episode=EpisodeConfig(max_steps=12, success_share=0.3))
    undelayed = flight(scenario, 60, 16)
    late = flight(replace(scenario, delay=DelayConfig(obs=3)), 60, 16)
    stored = buffer(scenario, 80, 16)
    stored.extend(late)
    known = in_order(stored, 60).transpose(0, 1)
    first = known["step_count"].squeeze(-1).cumsum(1) == torch.arange(60).cumsum(0)  # of each world
    began = first & known["valid"].squeeze(-1)
    ends, true_ends = (td["next", "success"].squeeze(-1) for td in (known, undelayed))
    for b in range(16):
        steps = began[b].nonzero().flatten()
        if true_ends[b, : len(steps)].any():
            assert ends[b, steps].tolist() == true_ends[b, : len(steps)].tolist()
    assert (~known["valid"]).any()
    assert known["next", "done"][known["reset_after"]].all()


def test_what_it_cannot_hold_is_refused():
    scenario = everything("instant", episode=PERSISTENT)
    late = flight(replace(scenario, delay=DelayConfig(obs=LATE)), 20)
    with pytest.raises(ValueError, match="max_size: 116 is too little for batches of 20 steps"):
        buffer(scenario, 29).extend(late)
    later = flight(replace(scenario, delay=DelayConfig(obs=LONGEST + 1)), 20)
    with pytest.raises(ValueError, match="longest: a message takes 6 steps, more than 5"):
        buffer(scenario, 64).extend(later)


@pytest.mark.parametrize(
    "sampler", [SamplerWithoutReplacement(), SliceSampler(num_slices=2, end_key=("next", "done"))]
)
def test_torchrls_samplers_work_on_it(sampler):
    scenario = everything("instant", episode=EpisodeConfig(max_steps=9))
    stored = buffer(scenario, 64, sampler=sampler)
    stored.extend(flight(replace(scenario, delay=DelayConfig(obs=LATE)), 40))
    assert stored.sample()["valid"].shape == (8, 1)


def test_it_is_saved_and_goes_on_as_before(tmp_path):
    scenario = everything("instant", episode=EpisodeConfig(max_steps=9))
    late = flight(replace(scenario, delay=DelayConfig(obs=LATE)), 40)
    one, other = buffer(scenario, 64), buffer(scenario, 64)
    one.extend(late[:, :25])
    one.dumps(tmp_path)
    other.loads(tmp_path)
    for stored in (one, other):
        stored.extend(late[:, 25:])
    known, again = in_order(one, 40), in_order(other, 40)
    assert all(known[key].equal(again[key]) for key in known.keys(True, True) if key != "index")


def test_the_message_of_a_uav_says_when_it_was_sent():
    late = flight(replace(square(), delay=DelayConfig(obs=LATE)), 12)
    sent = Messages.unpack(late["next", "agents", "message"])
    assert sent.time.equal(late["next", "step_count"].float().expand_as(sent.time))
