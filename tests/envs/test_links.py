"""How observations reach the UAVs: from the server at once or later, or over links of their own."""

import pytest
import torch
from delayed_envs import choices
from helpers import both_motions, everything, play
from torchrl.envs.utils import check_env_specs

from damian import ObservationDelay, keys, make_env
from damian.delays.config import DelayConfig, LinkConfig

LATE = "1..4"
EXTRAS = ["message", "reward_terms"]


def linked(motion="instant", **links):
    """An environment whose messages to the server are delayed too, and the outputs of its steps."""
    delay = DelayConfig(obs=LATE, loss=0.1)
    env = make_env(
        everything(
            motion,
            delay=delay,
            links=LinkConfig(**links),
        ),
        4,
        seed=2,
        extras=EXTRAS,
    )
    return env, play(env, choices(env, 20))


LINKS = {
    "updown": {"kind": "updown", "delay": LATE, "loss": 0.1},
    "matrix": {"kind": "matrix", "delay": LATE, "loss": 0.1},
    "range": {
        "kind": "matrix",
        "delay": {"law": "distance", "speed": 40.0},
        "range": 120.0,
    },
    "a law for each pair": {
        "kind": "matrix",
        "delay": [[0, 1, 2], [3, 0, LATE], [1, 1, 0]],
        "loss": [[0, 0, 1]] * 3,
    },
}
every_link = pytest.mark.parametrize("links", LINKS.values(), ids=LINKS)


@pytest.mark.sample(4)
@every_link
@both_motions
@pytest.mark.parametrize("extras", [(), EXTRAS])
def test_the_specs_are_right(links, motion, extras):
    scenario = everything(
        motion,
        delay=DelayConfig(obs=1, history=2),
        links=LinkConfig(**links),
    )
    env = make_env(scenario, 2, extras=extras)
    check_env_specs(env, break_when_any_done="both")
    assert keys.LINKED not in env.reset().keys(True, True)
    assert ("message" in extras) == (keys.MESSAGE in env.reset().keys(True, True))


@both_motions
def test_updown_shows_the_observation_that_the_server_computed_some_steps_ago(motion):
    _, at_once = linked(motion, kind="server")
    env, late = linked(motion, kind="updown", delay=2)
    assert isinstance(env.transform[-1], ObservationDelay)
    ends = torch.stack([td[keys.DONE] for td in at_once[1::2]]).squeeze(-1)
    compared = 0
    for world in range(4):
        since = 0  # steps since the reset
        for t in range(20):
            since += 1
            if since > 2:
                sent = at_once[2 * t - 3][world]  # two steps before
                assert late[2 * t + 1][keys.OBSERVATION][world].equal(sent[keys.OBSERVATION])
                compared += 1
            since = 0 if ends[t, world] else since
    assert compared > 10


@both_motions
def test_on_board_each_uav_computes_what_the_server_would_from_the_messages_that_have_reached_it(
    motion,
):
    delay = DelayConfig(obs=LATE)
    links = LinkConfig("matrix", delay=LATE, loss=0.2)
    env = make_env(
        everything(motion, delay=delay, links=links),
        4,
        seed=2,
        extras=EXTRAS,
    )
    env.transform[-1].dropped_keys = []
    n_old = 0
    steps = torch.zeros(4, dtype=torch.long)
    td = env.reset()
    for action in choices(env, 20):
        after, td = env.step_and_maybe_reset(td.set(keys.ACTION, action))
        steps = steps + 1
        output = after["next"]
        held = output[keys.LINKED]
        for receiver in range(held.shape[1]):
            known = env.server.messages(held[:, receiver])
            alone = env.server(known, steps).observation[:, receiver]
            assert output[keys.OBSERVATION][:, receiver].equal(alone)
            assert held[:, receiver, receiver].equal(output[keys.MESSAGE][:, receiver])
        n_old += (held != output[keys.MESSAGE].unsqueeze(1)).any(-1).sum().item()
        steps = steps * ~output[keys.DONE].view(-1)
    assert n_old > 50
