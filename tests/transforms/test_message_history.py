"""The transform ``MessageHistory`` against a slow twin, and that it shows nothing before it arrives."""

import pytest
import torch
from contract import LATE
from helpers import square
from tensordict import TensorDictBase
from torchrl.envs import Compose, TransformedEnv

from damian import keys
from damian.envs.uav_env import UavEnv
from damian.transforms import MessageHistory, ObservationDelay, set_seed

K, WORLDS, AGENTS = 3, 2, 3


def flown(law: object = LATE, loss: float = 0.2, **options) -> TensorDictBase:
    """Steps [B, T] over the ends of several episodes of 6 steps, in which half of the steps send nothing."""
    uav_env = UavEnv(square(), num_worlds=WORLDS, extras=["message"])
    delay = ObservationDelay(
        law, keys.MESSAGE, keys.RECEIVED, loss=loss, delay_key="delay", sent_key="message_sent"
    )
    history = MessageHistory(K, keys.MESSAGE, delay_key="delay", sent_key="message_sent", **options)
    env = TransformedEnv(uav_env, Compose(delay, history))
    set_seed(env, 5)
    torch.manual_seed(5)
    return env.rollout(20, break_when_any_done=False)


def twin(data: TensorDictBase, world: int, receiver: int, group: bool, own: bool) -> list[torch.Tensor]:
    """The history of one receiver after every step, from the messages and delays of one world."""
    steps, after, found, first = data[world], data[world]["next"], [], 0
    senders = [(receiver + i) % AGENTS for i in range(AGENTS)] if group else [receiver]
    for now in range(steps.shape[0]):
        if now and after["done"][now - 1]:
            first = now
        rows = []
        for sender in senders:
            for age in range(K):
                sent = now - age
                row = torch.zeros(steps[keys.MESSAGE].shape[-1] + 3)
                row[-2:] = torch.tensor([age / K, float(sender == receiver)])
                if sent >= first:
                    delay = int(after[keys.DELAY][sent, sender])
                    at_once = own and sender == receiver and bool(after[keys.MESSAGE_SENT][sent, sender])
                    if at_once or 0 <= delay <= age:
                        row[:-3], row[-3] = after[keys.MESSAGE][sent, sender], 1.0
                elif sent == first - 1:  # the message of the reset
                    row[:-3], row[-3] = steps[keys.MESSAGE][first, sender], 1.0
                rows.append(row)
        found.append(torch.stack(rows))
    return found


@pytest.mark.parametrize(("group", "own"), [(False, False), (True, False), (True, True)])
def test_the_history_holds_what_has_arrived_of_the_latest_steps(group, own):
    data = flown(group=group, own=own)
    assert data["next", "done"].sum() > WORLDS
    assert (data["next", "agents", "delay"] < 0).any()
    for world in range(WORLDS):
        for receiver in range(AGENTS):
            expected = torch.stack(twin(data, world, receiver, group, own))
            assert data[world]["next", "agents", "history"][:, receiver].equal(expected)
