"""The feature ``timeline``: slot k is where a UAV stood k steps ago, as far as that has arrived by now."""

import itertools

import pytest
import torch

from damian import keys, make_env
from damian.common.errors import InputError
from damian.delays.config import DelayConfig, LinkConfig
from damian.envs.config import ScenarioConfig
from damian.server.config import ObservationConfig
from damian.server.features.others import OTHERS
from damian.server.termination import EpisodeConfig
from damian.world.config import RegionConfig

SLOTS, AGENTS = 4, 3
AGES = ("agents", "received_age")
UNIFORM = {"law": "uniform", "low": 0, "high": 6}
CASES = {
    "no delay": {},
    "delays beyond the slots, losses": {"delay": DelayConfig(obs=UNIFORM, loss=0.2)},
    "held back": {"delay": DelayConfig(obs={"law": "uniform", "low": 0, "high": 2}, hold="max")},
    "links": {"links": LinkConfig("matrix", delay=UNIFORM, loss=0.2)},
}


def scenario(own: bool = True, **changed) -> ScenarioConfig:
    """UAVs that move at once and observe their own places and the timeline, in short episodes."""
    sections = {
        "agents": AGENTS,
        "region": RegionConfig(kind="random", pool=2, lattice_step=60.0),
        "observation": ObservationConfig(["place"], [], own=own, window=1, timeline=SLOTS),
        "episode": EpisodeConfig(max_steps=9),
    }
    return ScenarioConfig(**(sections | changed))


@pytest.mark.parametrize(("name", "own"), [*((name, True) for name in CASES), ("held back", False)])
def test_a_slot_tells_where_a_uav_stood_then_if_a_message_since_has_arrived(name, own):
    case = scenario(own and name != "links", **CASES[name])
    env = make_env(case, 4, seed=1, extras=["message"])
    if name == "links":
        env.transform[0].age_key = AGES
    torch.manual_seed(0)
    steps = env.rollout(25, break_when_any_done=False)
    server, after, seen = env.server, steps["next"], 0
    if name != "links":  # the ages of what each UAV knows of each, [B, T, N, N]
        age = after.get(keys.AGE, torch.zeros_like(after[keys.REWARD])).squeeze(-1)
        age = age.unsqueeze(-2).repeat(1, 1, AGENTS, 1)
        after[AGES] = age.masked_fill(torch.eye(AGENTS, dtype=torch.bool) & case.observation.own, 0)
    sent, first = server.messages(after[keys.MESSAGE]), server.messages(steps[keys.MESSAGE])
    half = server.scales(sent) / 2
    observed = after[keys.OBSERVATION][..., 2:].unflatten(-1, (OTHERS, 3 * SLOTS + 3))
    for world, t, i in itertools.product(range(4), range(25), range(AGENTS)):
        ended = after[keys.DONE][world, :t].flatten().nonzero()
        begin = int(ended[-1]) + 1 if len(ended) else 0
        places = [first.position[world, begin], *sent.position[world, begin : t + 1]]  # in this episode
        ages = after[AGES][world, t, i].long().tolist()
        here, expected = places[-1 - ages[i]][i], []
        for j in range(AGENTS):
            if j != i:
                rows = torch.zeros(SLOTS + 1, 3)
                for k in range(ages[j], min(SLOTS, len(places))):
                    way = ((places[-1 - k][j] - here) / half[world, t]).clamp(-1, 1)
                    rows[k] = torch.tensor([*way, 1.0])
                    seen += 1
                expected.append((float((places[-1 - ages[j]][j] - here).norm()), rows.flatten().tolist()))
        expected.sort()
        assert not observed[world, t, i, AGENTS - 1 :].any()
        if expected[1][0] - expected[0][0] > 1e-2:  # else in any order
            values = torch.tensor([row for _, row in expected])
            assert observed[world, t, i, : AGENTS - 1].allclose(values, atol=1e-5), (world, t, i)
    assert seen > 500


def test_a_timeline_needs_the_order_of_generation():
    with pytest.raises(InputError, match=r"observation\.timeline: 4 does not go with delay\.order=arrival"):
        scenario(delay=DelayConfig(obs=2, order="arrival"))
