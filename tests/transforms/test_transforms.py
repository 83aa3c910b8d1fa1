"""Causality, independence of the worlds, added delays, and every kind of action."""

from collections.abc import Sequence

import pytest
import torch
from helpers import all_same, play
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from transform_cases import ACTION, LAWS, N_AGENTS, OBSERVATION, PAPER, REWARD, WORLDS, choices, delayed

from damian.delays.laws import Burst, Geometric
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    CumulativeReward,
    ObservationDelay,
    RewardDelay,
    SampleAndHold,
    StatefulTransform,
)

# Causality: no value has an effect before it arrives.


def differs(outputs: Sequence[TensorDictBase], others: Sequence[TensorDictBase], *key: str) -> Tensor:
    """Steps and agents at which an entry differs, [T, B, N] bool."""
    pairs = zip(outputs[1::2], others[1::2], strict=True)
    return torch.stack([(a[key] != b[key]).flatten(2).any(-1) for a, b in pairs])


def only_steps(first: int, last: int, w: int, n: int, total: int) -> Tensor:
    """A mask that is true only for the steps first <= t <= last of one agent, [T, B, N] bool."""
    mask = torch.zeros(total, len(WORLDS), N_AGENTS, dtype=torch.bool)
    mask[first - 1 : last, w, n] = True
    return mask


@pytest.mark.sample(2)
@pytest.mark.parametrize("order", ["generation", "arrival"])
@pytest.mark.parametrize("name", ["constant", "uniform", "geometric", "trace"])
def test_a_message_has_no_effect_before_it_arrives(name, order, tmp_path):
    n_steps, arrived = 25, 0

    def rollout(tampered: tuple[int, int, int] | None) -> list[TensorDictBase]:
        law = LAWS[name](tmp_path)
        delay = ObservationDelay(law, [OBSERVATION], order=order, delay_key="delay")
        return play(delayed(delay, ends=0.0, tampered=tampered), choices(n_steps=n_steps))

    honest = rollout(None)
    for w, n, sent in ((0, 0, 3), (1, 1, 7), (2, 0, 8), (3, 0, 12), (3, 1, 15)):
        changed = differs(honest, rollout((w, n, sent)), *OBSERVATION)
        arrival = sent + int(honest[2 * sent - 1]["agents", "delay"][w, n])
        assert not changed[: arrival - 1].any()
        changed[:, w, n] = False
        assert not changed.any()
        arrived += differs(honest, rollout((w, n, sent)), *OBSERVATION)[arrival - 1, w, n].item()
    assert arrived > 0


def test_an_action_has_no_effect_before_it_is_executed():
    others = choices(n_steps=20)
    others[6][2, 1] += 1  # chosen before the 7th step
    rollouts = [
        play(delayed(ActionDelay(4, ACTION), ends=0.0), actions) for actions in (choices(n_steps=20), others)
    ]
    assert differs(*rollouts, *OBSERVATION).equal(only_steps(11, 20, 2, 1, 20))


def test_a_reward_has_no_effect_before_it_is_received():
    def rollout(tampered: tuple[int, int, int] | None) -> list[TensorDictBase]:
        return play(delayed(RewardDelay(4, REWARD), ends=0.0, tampered=tampered), choices(n_steps=20))

    assert differs(rollout(None), rollout((2, 1, 6)), *REWARD).equal(only_steps(10, 10, 2, 1, 20))


# Independence of the worlds.


def one_of_each() -> list[StatefulTransform]:
    """One transform of each class, with random delays."""
    keys = {"fresh_key": "fresh", "delay_key": "delay"}
    return [
        ActionDelay(Geometric(1, 4), ACTION, loss=0.1, sent_key="ready"),
        ObservationDelay(
            Burst(0.2, 0.3), [OBSERVATION], [("agents", "seen")], sent_key="message_sent", **keys
        ),
        RewardDelay(PAPER, REWARD),
        CumulativeReward(3, 0.9, REWARD),
        SampleAndHold(2, [("agents", "seen")], ready_key=("agents", "ready"), age_key="age"),
        ActionHistory(3, ACTION, append_to=("agents", "seen"), recorded_key="ready"),
    ]


def test_a_worlds_outputs_do_not_depend_on_the_other_worlds():
    together = play(delayed(*one_of_each()), choices())
    assert sum(td["done"].sum().item() for td in together) > 10
    for w, world in enumerate(WORLDS):
        alone = play(delayed(*one_of_each(), worlds=[world]), choices([world]))
        assert all_same([td[w : w + 1] for td in together], alone)


# Delays of actions and of observations together.


@pytest.mark.parametrize("i", range(4))
@pytest.mark.parametrize("j", range(4))
def test_delays_of_observations_and_actions_add_up(i, j):
    """Delays i and j have the same effect as an observation delay i + j (Katsikopoulos, Engelbrecht 2003).

    With both delays, the agent makes the same decisions, but j steps earlier.
    """

    def decide(td: TensorDictBase) -> Tensor:
        return ((td[OBSERVATION] * torch.arange(1.0, 8)).sum(-1) % 7).long()

    def run(env: EnvBase, default_steps: int) -> tuple[Tensor, Tensor, Tensor]:
        td, observed, executed, rewards = env.reset(), [], [], []
        for t in range(20):
            action = torch.zeros(len(WORLDS), N_AGENTS, dtype=torch.long) if t < default_steps else decide(td)
            observed.append(td[OBSERVATION])
            stepped, td = env.step_and_maybe_reset(td.set(ACTION, action))
            executed.append(env.base_env.executed)
            rewards.append(stepped["next", *REWARD])
        return torch.stack(observed), torch.stack(executed), torch.stack(rewards)

    both = run(delayed(ActionDelay(j, ACTION), ObservationDelay(i, [OBSERVATION]), ends=0.0), 0)
    summed = run(delayed(ObservationDelay(i + j, [OBSERVATION]), ends=0.0), j)
    assert both[0][: 20 - j].equal(summed[0][j:])
    assert both[1].equal(summed[1])
    assert both[2].equal(summed[2])
    assert len(both[1].unique()) > 3
