"""UAVs that attend to what they have heard of each other: what they observe of it, and that they
learn."""

import csv

import pytest
import torch
from extensions import TINY
from helpers import check_refused
from tensordict import TensorDict

from damian import ScenarioConfig, keys, make_env
from damian.common.errors import InputError
from damian.delays.config import LinkConfig
from damian.models.actor import make_actor
from damian.recipes import cli
from damian.recipes.shared import learning
from damian.server.config import ObservationConfig

WINDOW = 2
WIDTH = 2 * WINDOW + 5


def make(agents):
    observation = ObservationConfig(["spotted"], ["talking:heard"], window=WINDOW)
    links = LinkConfig(
        kind="matrix",
        delay="1..4",
    )
    return make_env(
        ScenarioConfig(agents=agents, observation=observation, links=links),
        2,
        0,
        extras=["message"],
    )


@pytest.mark.parametrize("agents", [2, 4])
def test_what_a_uav_hears_equals_a_plain_loop_over_the_others(example, agents):
    env = make(agents)
    env.transform[-1].dropped_keys = []
    steps = env.rollout(9)
    server = env.uav_env.server
    points = env.uav_env.simulation.points
    half = env.uav_env.simulation.airspace.scale[0] / 2
    seen = steps["next"][keys.OBSERVATION][..., :-1].unflatten(-1, (agents - 1, WIDTH))
    for world in range(2):
        for step in range(9):
            known = server.messages(steps["next"][keys.LINKED][world, step])
            for i in range(agents):
                others = [j for j in range(agents) if j != i]
                for row, j in zip(seen[world, step, i], others, strict=True):
                    places = [known.target[i, j], *points[known.trail[i, j]]]
                    ways = torch.cat([(place - known.target[i, i]) / half for place in places])
                    age = (step + 1) * env.uav_env.scenario.clock.dt - known.time[i, j]
                    rest = torch.stack([known.spotted[i, j].float(), age / 10, torch.tensor(1.0)])
                    torch.testing.assert_close(row, torch.cat([ways, rest]).clamp(-1, 1))
    assert seen[..., -2].unique().numel() > 2, "the ages differ"


def test_attention_takes_the_others_in_any_order_and_number_and_reads_their_ages(example):
    torch.manual_seed(0)
    model = example.AttentionConfig(hidden=[8], width=8)
    three, five = (make_actor(make(n), model) for n in (3, 5))
    five.load_state_dict(three.state_dict())
    n_actions = make(5).full_action_spec_unbatched[keys.ACTION].n
    heard = torch.randn(4, 5, 4, WIDTH)
    own = torch.rand(4, 5, 1)

    def logits(rows):
        seen = {keys.OBSERVATION: torch.cat([rows.flatten(-2), own], -1)}
        seen[keys.ACTION_MASK] = torch.ones(4, 5, n_actions, dtype=torch.bool)
        return five.get_dist(TensorDict(seen, [4])).logits

    torch.testing.assert_close(logits(heard.flip(-2)), logits(heard))
    older = heard.clone()
    older[..., 0, -2] += 1
    assert not torch.allclose(logits(older), logits(heard), atol=1e-5)


def test_who_talks_is_trained_and_flown_in_another_number(run):
    words = ["observation.global_features=[talking:heard]", "model=talking:AttentionConfig"]
    first = run(*TINY, *words, "links=matrix", "links.delay=2", "aware=backupdate", "delay.obs=2")
    flown = run(f"checkpoint={first}", "agents=4", "trust=true", program="evaluate", name="flown")
    with (flown / "result.csv").open(newline="") as file:
        assert float(next(csv.DictReader(file))["return"]) >= 0


ROWS = "learner=extensions:RowsConfig"
OWN = "observation.own=true"


@pytest.mark.sample(3)
@pytest.mark.parametrize(
    ("words", "refused"),
    [
        ([ROWS, OWN, "learner.hidden=true"], True),
        ([ROWS, "links=matrix"], True),
        ([ROWS], False),
        ([ROWS, OWN, "learner.talks=true"], False),
        ([OWN], False),
        ([OWN, "actions.kind=continuous"], False),
        ([OWN, "model.rnn=gru"], False),
        ([OWN, "model.shared=false"], False),
        ([OWN, "observation.belief=[belief_gain]", "model.prior=true"], False),
        ([OWN, "learner=sac"], False),
        (
            [
                "links=matrix",
                "observation.global_features=[talking:heard]",
                "model=talking:AttentionConfig",
            ],
            False,
        ),
    ],
    ids=str,
)
def test_an_actor_by_which_uavs_talk_without_delay_is_refused(example, words, refused):
    config = cli.settings(*TINY, "delay.obs=3", *words)
    env = learning.learning_env(config)
    learner = learning.make_learner(config, env, learning.replay_buffer(config, env))
    learning.make_collector(env, learner.actor, 64)
    before = torch.get_rng_state(), [each.clone() for each in learner.actor.parameters()]
    if refused:
        with pytest.raises(
            InputError, match=r"reads other UAVs' rows, .* or give learner\.talks=true"
        ):
            learning.require_delayed_talk(config, env, learner)
    else:
        learning.require_delayed_talk(config, env, learner)
    after = torch.get_rng_state(), learner.actor.parameters()
    assert before[0].equal(after[0])
    assert all(old.equal(new) for old, new in zip(before[1], after[1], strict=True))


def test_undelayed_talk_is_refused_before_anything_is_written(run, folder, capsys):
    check_refused(
        lambda: run(*TINY, ROWS, OWN, "delay.obs=3"), "observation.own=true hold what each", capsys
    )
    assert not [each for each in (folder / "run").rglob("*") if each.is_file()]
