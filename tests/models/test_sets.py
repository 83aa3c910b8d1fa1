"""Networks of sets: what they give does not change with the order and the number of rows; and an
actor that begins as the script."""

import pytest
import torch

from damian import ScenarioConfig, keys, make_env
from damian.common.errors import InputError
from damian.models.actor import make_actor
from damian.models.config import MlpConfig, SetsConfig
from damian.recipes.shared.environments import compose_scenario
from damian.server.layout import Layout

SETS = SetsConfig(hidden=[16], width=8)
CROWDED = ["scenario=delaybench/crowded", "observation.actions=true", "agents=4"]


def layout(n_others, n_actions):
    """Blocks of two lists, one of them in two blocks, and of one value."""
    found = Layout().appended("others", (n_others, 3), rows="others")
    found = found.appended("battery", ())
    found = found.appended("timeline", (n_others, 2, 2), rows="others")
    found = found.appended("requests", (5, 3), rows="requests")
    return found.appended("actions", (n_actions, 4), rows="actions")


def joined(blocks, values):
    """An observation [*, F] of values by name."""
    return torch.cat([values[b.name].reshape(*values["battery"].shape, -1) for b in blocks], -1)


@pytest.mark.parametrize("n_out", [1, 6])
def test_order_and_number_of_rows_change_nothing(n_out):
    torch.manual_seed(0)
    few, many = layout(3, 6), layout(5, 6)
    network, larger = (SETS.make_network(each, n_out) for each in (few, many))
    larger.load_state_dict(network.state_dict())
    values = {block.name: torch.randn(7, *block.shape) for block in few}
    expected = network(joined(few, values))
    assert expected.shape == (7, n_out)

    def of(**changed):
        return network(joined(few, values | changed))

    order = torch.tensor([2, 0, 1])
    turned = {name: values[name][:, order] for name in ("others", "timeline")}
    torch.testing.assert_close(of(**turned), expected)
    torch.testing.assert_close(of(requests=values["requests"].flip(1)), expected)
    flipped = of(actions=values["actions"].flip(1))
    torch.testing.assert_close(flipped, expected.flip(-1) if n_out > 1 else expected)
    assert not of(others=turned["others"]).allclose(expected), "lists are read row by row"
    empty = {
        name: torch.cat([values[name], torch.zeros_like(values[name][:, :2])], 1)
        for name in ("others", "timeline")
    }
    torch.testing.assert_close(larger(joined(many, values | empty)), expected)


@pytest.fixture(scope="module")
def crowded():
    """An environment whose actors observe actions, and three steps in it."""
    env = make_env(compose_scenario(*CROWDED, "region.initial_conditions=16"), 3, seed=0)
    return env, env.rollout(3)


@pytest.mark.parametrize("model", [SETS, MlpConfig(hidden=[8])])
@pytest.mark.parametrize("changed", [{}, {"rnn": "gru"}, {"shared": False}], ids=str)
def test_with_a_prior_an_actor_begins_as_the_script(crowded, model, changed):
    env, steps = crowded
    actor = make_actor(env, type(model)(hidden=model.hidden, prior=True, **changed))
    entries = steps.select(keys.OBSERVATION, keys.ACTION_MASK).clone()
    hidden = torch.randn(3, 3, 4, model.hidden[-1])
    entries[keys.HIDDEN] = hidden
    block = env.layout["observation"]["actions"]
    gain = block.of(entries[keys.OBSERVATION])[..., block.entries.index("gain")]
    logits = actor.get_dist(entries).logits
    choice = block.of(entries[keys.OBSERVATION])[..., block.entries.index("choice")]
    expected = (
        (40 * gain + 2 * choice).masked_fill(~entries[keys.ACTION_MASK], -torch.inf).log_softmax(-1)
    )
    torch.testing.assert_close(logits.exp(), expected.exp())


def test_a_prior_without_gains_is_refused():
    env = make_env(ScenarioConfig(), 2)
    with pytest.raises(InputError, match=r"model\.prior: True needs gains: observation.actions"):
        make_actor(env, SetsConfig(prior=True))
