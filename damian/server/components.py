"""Checks that features and reward terms, built-in or your own, have the shapes and bounds they
declare."""

from collections.abc import Mapping
from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from damian import keys
from damian.common import checks
from damian.common.errors import naming_errors
from damian.common.tensors import tree_map, where_rows
from damian.server.features import feature_of
from damian.server.layout import Layout
from damian.server.rewards import Counters
from damian.server.server import Features, Server
from damian.world.messages import Messages

_WORLDS = 16
_ROUNDING = 1e-5


def checked_features(server: Server, messages: Messages, steps: Tensor) -> Features:
    """All features of the first messages of episodes [B, N], checked against what they declare.

    Values are finite and within bounds, and a local feature follows from the UAV's own message
    alone. A reward term of these features gives one value for each UAV. What only later messages
    show is not found.

    Raises:
        InputError: a component does not keep what it declares; the message names it.
    """
    some = tree_map(lambda field: field[:_WORLDS], messages)
    elapsed = steps[:_WORLDS]
    found = {}
    for name in server.names:
        declared = feature_of(name)
        key = f"feature {name}"
        with naming_errors(key):
            found |= server.features(messages, steps, [name])
            values = found[name].float()
            within = (values >= declared.low - _ROUNDING) & (values <= declared.high + _ROUNDING)
            checks.require(
                bool(within.all()),
                key,
                f"{[*values[~within], 0][0]:g}",
                f"is not between {declared.low:g} and {declared.high:g}: scale it, or declare its "
                "bounds",
            )
            if declared.scope == "local":
                own = _among_others(server, name, some, elapsed)
                same = own.float().allclose(values[:_WORLDS], atol=_ROUNDING)
                checks.require(
                    same,
                    key,
                    "local",
                    "changes with the messages of other UAVs: make it global, or read only the "
                    "UAV's own",
                )
    for term in server.terms.values():
        with naming_errors(f"reward term {term.name}"):
            term.value(found, Counters(steps, messages.motions, messages.time >= 0))
    return found


def _among_others(server: Server, name: str, messages: Messages, steps: Tensor) -> Tensor:
    """A feature [B, N] of what UAVs know who know other messages of each other than these,
    [B, N]."""
    n = messages.time.shape[-1]
    own = torch.eye(n, dtype=torch.bool, device=steps.device).expand(len(steps), n, n)

    def changed_of_others(field: Tensor) -> Tensor:
        if field.dtype == torch.bool:
            other = ~field
        elif field.is_floating_point():
            other = field + 1
        else:
            other = field.roll(
                1, 1
            )  # those of another UAV of its world: landing points of one region
        return where_rows(own, field.unsqueeze(1), other.unsqueeze(1))

    return server.own_features(tree_map(changed_of_others, messages), steps, [name])[name]


def not_finite(layouts: Mapping[str, Layout], steps: TensorDictBase) -> str | None:
    """Which feature or reward term of collected steps [*] is not finite; None if all are."""
    for key in (keys.OBSERVATION, keys.GLOBAL_OBSERVATION):
        for values in (steps[key], steps[keys.next_key(key)]):
            if not values.isfinite().all():
                blocks = layouts[keys.last_part(key)]
                wrong = [block.name for block in blocks if not block.of(values).isfinite().all()]
                return f"feature {', '.join(wrong)}: a value is nan or infinite"
    terms = cast(TensorDictBase, steps[keys.next_key(keys.REWARD_TERMS)])
    wrong = [name for name, values in terms.items() if not values.isfinite().all()]
    return f"reward term {', '.join(wrong)}: a value is nan or infinite" if wrong else None
