"""A short flight that shows whether components from outside the package keep what they declare."""

import math
from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from damian import keys
from damian.common import checks
from damian.common.errors import naming_errors
from damian.common.tensors import tree_map, tree_where
from damian.server.features import feature_of, stack
from damian.server.rewards import Counters
from damian.server.server import Server
from damian.world.simulation import Simulation
from damian.world.state import State

WORLDS, STEPS = 16, 24
_ROUNDING = 1e-5


def try_own_components(server: Server, simulation: Simulation) -> None:
    """Fly ``STEPS`` steps of random actions, and check features, reward terms and motion models of users.

    Values are finite and within the declared bounds, a local feature follows from the UAV's own message
    alone, and a motion model keeps the types of the state. (Shapes are checked wherever values are computed.)
    Without such components nothing is flown. What only later states show is not found.

    Raises:
        InputError: a component does not keep what it declares; the message names it.
    """
    names = [name for name in server.names if _is_own(feature_of(name).compute)]
    terms = {name: each for name, each in server.terms.items() if _is_own(each.term.compute)}
    if not (names or terms or _is_own(type(simulation.vehicles))):
        return
    draw, config = torch.Generator().manual_seed(0), simulation.config
    state = first = tree_map(lambda table: table[:WORLDS], simulation.initial)
    with torch.random.fork_rng(devices=[]):  # a component may draw, but a training draws the same as without
        for _ in range(STEPS):
            for name in names:
                with naming_errors(f"feature {name}"):
                    _check_feature(server, name, state, first)
            features = server.features(state.sent, state.steps) if terms else {}
            for name, each in terms.items():
                with naming_errors(f"reward term {name}"):
                    values = each.value(features, Counters(state.steps, state.sent.motions))
                _check(f"reward term {name}", values)
            action = torch.rand(*state.track.shape, 2, generator=draw)
            if config.actions.kind == "discrete":
                action = (action[..., 0] * config.actions.n_actions).long()
            before, key = state, f"motion.kind: {config.motion.kind}"
            with naming_errors(key):
                state = simulation.step(state, action.to(state.track.device))
            for name, old, new in zip(State._fields[:-1], before, state, strict=False):
                checks.require(new.dtype == old.dtype, f"{key}: {name}", new.dtype, f"is not {old.dtype}")
                _check(f"{key}: {name}", new)


def not_finite(server: Server, simulation: Simulation, steps: TensorDictBase) -> str | None:
    """Which feature or reward term of collected steps [*] is not finite; None if all are."""
    first, observation = simulation.initial, server.observation
    for key, names in ((keys.OBSERVATION, observation.actor), (keys.GLOBAL_OBSERVATION, observation.critic)):
        for values in (steps[key], steps[keys.next_key(key)]):
            if not values.isfinite().all():
                features = server.features(first.sent, first.steps)
                widths = [stack(features, [name]).shape[-1] for name in names]
                columns = values[..., : sum(widths)].split(widths, -1)
                wrong = [name for name, x in zip(names, columns, strict=True) if not x.isfinite().all()]
                return f"feature {', '.join(wrong)}: a value is nan or infinite"
    terms = cast(TensorDictBase, steps[keys.next_key(keys.REWARD_TERMS)])
    wrong = [name for name, values in terms.items() if not values.isfinite().all()]
    return f"reward term {', '.join(wrong)}: a value is nan or infinite" if wrong else None


def _is_own(component: object) -> bool:
    return component.__module__.partition(".")[0] != "damian"


def _check_feature(server: Server, name: str, state: State, first: State) -> None:
    """Check a feature of the messages of a state; ``first`` is an earlier one of the same worlds."""
    declared, n = feature_of(name), state.track.shape[-1]
    alone = server.features(state.sent, state.steps, [name])[name]
    _check(f"feature {name}", alone, declared.low, declared.high)
    for uav in range(n if declared.scope == "local" else 0):
        own = (torch.arange(n, device=alone.device) == uav).expand(len(alone), n)
        mixed = tree_where(own, state.sent, first.sent)
        among_others = server.features(mixed, state.steps, [name])[name]
        same = among_others[:, uav].float().allclose(alone[:, uav].float(), atol=_ROUNDING)
        problem = "changes with the messages of other UAVs: make it global, or read only the UAV's own"
        checks.require(same, f"feature {name}", "local", problem)


def _check(key: str, values: Tensor, low: float = -math.inf, high: float = math.inf) -> None:
    """Require finite values within bounds."""
    number = values.double()
    wrong = number[~((number >= low - _ROUNDING) & (number <= high + _ROUNDING) & number.isfinite())]
    bounds = f"between {low:g} and {high:g}, which it declares: scale it, or declare its bounds"
    should = f"is not {bounds if math.isfinite(low) else 'finite'}"
    checks.require(not len(wrong), key, f"{wrong[0].item() if len(wrong) else 0:g}", should)
