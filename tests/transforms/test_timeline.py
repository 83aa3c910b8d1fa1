"""The transform ``ObservationTimeline`` against a slow twin: what has arrived, and nothing else."""

import pytest
import torch
from environments import LATE
from helpers import square
from torchrl.data import ReplayBuffer
from torchrl.envs import Compose, GymEnv, StepCounter, TransformedEnv

from damian import (
    Channel,
    ObservationDelay,
    ObservationTimeline,
    UavEnv,
    keys,
    set_seed,
)
from damian.replay.backupdate import BackupdateStorage, corrections_of

K = 3
WORLDS = 2
AGENTS = 3
ALL = [(False, False), (True, False), (True, True)]
"""Whether a timeline is that of a group, and whether it has one's own messages at once."""


def late_uavs(law=LATE, loss=0.2, links=False, **options):
    """UAVs that send nothing in half of the steps; ``links``: every receiver has delays of its
    own."""
    uav_env = UavEnv(square(), num_worlds=WORLDS, extras=["message"])
    options |= {"delay_key": "delay", "sent_key": "message_sent"}
    if links:
        late = Channel(law, keys.MESSAGE, loss=loss, delay_key="delay", sent_key="message_sent")
    else:
        late = ObservationDelay(
            law, keys.MESSAGE, keys.RECEIVED, loss=loss, delay_key="delay", sent_key="message_sent"
        )
    timeline = ObservationTimeline(K, keys.MESSAGE, **options)
    env = TransformedEnv(uav_env, Compose(late, timeline, StepCounter()))
    set_seed(env, 5)
    torch.manual_seed(5)
    return env


def twin(
    data,
    world,
    receiver,
    group,
    own,
    until=None,
):
    """The timeline of one receiver after every step, from the messages and delays of one world.

    With ``until``, it is that of hindsight: from what has arrived after that step.
    """
    steps = data[world]
    after = data[world]["next"]
    found = []
    first = 0
    senders = [(receiver + i) % AGENTS for i in range(AGENTS)] if group else [receiver]

    def arrived(entries, sender, since):
        delay = entries[keys.DELAY][sender]
        return 0 <= int(delay[receiver] if len(delay) > 1 else delay) <= since

    for now in range(steps.shape[0]):
        if now and after["done"][now - 1]:
            first = now
        rows = []
        for sender in senders:
            for age in range(K):
                sent = now - age
                since = (now if until is None else until) - (now - age)
                row = torch.zeros(steps[keys.MESSAGE].shape[-1] + 1)
                is_own = own and sender == receiver
                if sent >= first:
                    at_once = is_own and bool(after[keys.MESSAGE_SENT][sent, sender])
                    known = arrived(after[sent], sender, since) or at_once
                    message = after[sent]
                else:  # the message of the reset, or one before it
                    known = sent == first - 1 and (arrived(steps[first], sender, since) or is_own)
                    message = steps[first]
                if known:
                    row[:-1], row[-1] = message[keys.MESSAGE][sender], 1.0
                rows.append(row)
        found.append(torch.stack(rows))
    return found


@pytest.mark.parametrize("links", [False, True])
@pytest.mark.parametrize(("group", "own"), ALL)
def test_the_timeline_holds_what_has_arrived_of_the_latest_steps(group, own, links):
    if links and not group:
        return
    data = late_uavs(
        links=links,
        group=group,
        own=own,
    ).rollout(20, break_when_any_done=False)
    assert data["next", "done"].sum() > WORLDS
    assert (data["next", "agents", "delay"] < 0).any()
    for world in range(WORLDS):
        transposed = data.clone()
        if links:  # by sender and receiver
            for key in (keys.DELAY, ("next", *keys.DELAY)):
                transposed[key] = data[key].transpose(-1, -2)
        for receiver in range(AGENTS):
            expected = torch.stack(twin(transposed, world, receiver, group, own))
            found = data[world]["next", "agents", "timeline"][:, receiver]
            assert found.reshape(expected.shape).equal(expected)


def test_what_a_sender_knows_itself_stands_in_a_timeline_of_its_own():
    env = late_uavs(own_key="own_timeline")
    steps = env.rollout(20, break_when_any_done=False)
    for world in range(WORLDS):
        for sender in range(AGENTS):
            expected = torch.stack(twin(steps, world, sender, False, True))
            found = steps[world]["next", "agents", "own_timeline"][:, sender]
            assert found.reshape(expected.shape).equal(expected)


@pytest.mark.parametrize(("group", "own"), ALL)
def test_stored_timelines_are_corrected_by_what_has_arrived_since(group, own):
    env = late_uavs(group=group, own=own)
    key = ("agents", "timeline")
    storage = BackupdateStorage(
        1000, lambda steps, latest: {}, 3, corrections=corrections_of(env.transform, [key])
    )
    buffer = ReplayBuffer(storage=storage)
    steps = env.rollout(17, break_when_any_done=False)
    for end, part in zip((7, 8, 17), steps.split([7, 1, 9], 1), strict=True):
        buffer.extend(part)
        data = steps[:, :end]
        stored = storage.steps[storage.latest()].transpose(0, 1)
        for world in range(WORLDS):
            for receiver in range(AGENTS):
                expected = torch.stack(
                    twin(data, world, receiver, group, own, until=data.shape[1] - 1)
                )
                found = stored[world]["next", *key][:, receiver].reshape(expected.shape)
                assert found.equal(expected)
    assert not stored["next", *key].equal(data["next", *key])


def test_places_relative_to_the_observer_are_moved_into_its_present_frame():
    """Pendulum's first two numbers serve as the observer's position; a place at the origin stays
    there."""
    from torchrl.envs import UnaryTransform  # noqa: PLC0415

    relative = UnaryTransform(["observation"], ["place"], fn=lambda o: -o[..., :2])
    own = UnaryTransform(["observation"], ["own"], fn=lambda o: o[..., :2])
    late = ObservationDelay(LATE, "place", "received", delay_key="delay", seed=0)
    timeline = ObservationTimeline(4, "place", delay_key="delay", position_key="own")
    env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(relative, own, late, timeline))
    steps = env.rollout(8)["next"]
    known = steps["timeline"][..., -1]
    assert 0 < known.sum() < known.numel()
    expected = -steps["own"].unsqueeze(-2) * known.unsqueeze(-1)
    assert steps["timeline"][..., :-1].allclose(expected, atol=1e-6)
