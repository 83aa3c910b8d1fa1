"""The recomputation that a ``BackupdateStorage`` uses for UAVs: the server node once more."""

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from damian import keys
from damian.keys import next_key
from damian.replay.backupdate import Recompute
from damian.server.server import Server
from damian.world.messages import Messages


def server_recompute(server: Server, reward_terms: bool = False, actor: bool = False) -> Recompute:
    """What the server would have output at stored steps, had it held other messages.

    Args:
        server: of the environment.
        reward_terms: recompute ``reward_terms`` too.
        actor: and the features that the server sends the actors, which come first in their observations; what
            an actor remembers by itself, such as its past actions, stays.

    Returns:
        for ``BackupdateStorage(recompute=...)``.
    """

    def recompute(steps: TensorDictBase, messages: Tensor) -> dict[NestedKey, Tensor]:
        elapsed = steps[next_key(keys.STEP_COUNT)].squeeze(-1)
        source_over = steps.get(next_key(keys.SOURCE_OVER), None)
        outputs = server(Messages.unpack(messages), elapsed, source_over)
        entries: dict[NestedKey, Tensor] = {
            keys.GLOBAL_OBSERVATION: outputs.global_observation,
            keys.REWARD: outputs.reward.unsqueeze(-1),
            **outputs.status.entries(),
        }
        if actor:
            sent, before = steps[next_key(keys.MESSAGE)], steps[next_key(keys.OBSERVATION)]
            own = server.observation.own
            features = (
                server.observe_with_timely_messages(messages, sent, elapsed) if own else outputs.observation
            )
            entries[keys.OBSERVATION] = torch.cat([features, before[..., features.shape[-1] :]], -1)
        if reward_terms:
            entries |= {(*keys.REWARD_TERMS, name): term for name, term in outputs.terms.items()}
        return {next_key(key): value for key, value in entries.items()}

    return recompute
