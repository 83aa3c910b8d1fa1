"""Recomputes stored steps of UAVs with the server node, for ``BackupdateStorage``."""

from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from damian import keys
from damian.keys import next_key
from damian.replay.step_keys import Recompute
from damian.server.server import Server


def server_recompute(server: Server, reward_terms: bool = False, actor: bool = False) -> Recompute:
    """A function that computes what the server would have output at stored steps, had it held other messages.

    Args:
        server: server node of the environment.
        reward_terms: recompute ``reward_terms`` too.
        actor: recompute the actors' observations too, without what ``ActionHistory`` appends to them
            (``corrections_of`` keeps that).

    Returns:
        The function, for ``BackupdateStorage(recompute=...)``.
    """

    def recompute(steps: TensorDictBase, messages: Tensor) -> dict[NestedKey, Tensor]:
        elapsed = steps[next_key(keys.STEP_COUNT)].squeeze(-1)
        source_over = steps.get(next_key(keys.SOURCE_OVER), None)
        outputs = server(server.messages(messages), elapsed, source_over)
        entries: dict[NestedKey, Tensor] = {
            keys.GLOBAL_OBSERVATION: outputs.global_observation,
            keys.REWARD: outputs.reward.unsqueeze(-1),
            **outputs.status.entries(),
        }
        if actor:
            sent, own = steps[next_key(keys.MESSAGE)], server.observation.own
            entries[keys.OBSERVATION] = (
                server.observe_with_timely_messages(messages, sent, elapsed) if own else outputs.observation
            )
        if reward_terms:
            entries |= {(*keys.REWARD_TERMS, name): term for name, term in outputs.terms.items()}
        return {next_key(key): value for key, value in entries.items()}

    return recompute
