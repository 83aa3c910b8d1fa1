"""A short flight that shows whether components from outside the package keep what they declare."""

import math
from collections.abc import Sequence
from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from damian import keys
from damian.common import checks
from damian.common.errors import naming_errors
from damian.common.tensors import tree_map, tree_where
from damian.server.features import feature_of, stack
from damian.server.rewards import Counters, features_read, own_terms
from damian.server.server import Server
from damian.world.simulation import Simulation
from damian.world.state import State

WORLDS, STEPS = 16, 24
_ROUNDING = 1e-5


def try_own_components(server: Server, simulation: Simulation) -> None:
    """Fly ``STEPS`` steps of random actions, and check sensors, features, reward terms and motion of users.

    Values have the declared shape and bounds, and are finite; a local feature follows from the UAV's own
    message alone. Without such components nothing is flown. What only later states show is not found.

    Raises:
        InputError: a component does not keep what it declares; the message names it.
    """
    observation, terms = server.observation, own_terms(server.reward)
    read = {*observation.actor, *observation.critic, *features_read(server.reward)}
    names = [name for name in sorted(read) if _is_own(feature_of(name).compute)]
    moves = _is_own(type(simulation.vehicles))
    if not (names or terms or moves or simulation.sensors):
        return
    draw, config = torch.Generator().manual_seed(0), simulation.config
    state = first = tree_map(lambda table: table[:WORLDS], simulation.initial)
    with torch.random.fork_rng(devices=[]):  # a component may draw, but a training draws the same as without
        for _ in range(STEPS):
            widths = [sensor.width for sensor in simulation.sensors.values()]
            for name, values in zip(simulation.sensors, state.sent.readings.split(widths, -1), strict=True):
                _check(f"sensor {name}", values, values.shape)
            for name in names:
                with naming_errors(f"feature {name}"):
                    _check_feature(server, name, state, first)
            features = server.features(state.sent, state.steps) if terms else {}
            for name, own in terms.items():
                known, counters = (
                    {n: features[n] for n in own.term.reads},
                    Counters(state.steps, state.sent.motions),
                )
                with naming_errors(f"reward term {name}"):
                    values = own.term.compute(known, counters, **own.parameters)
                _check(f"reward term {name}", values, state.track.shape)
            action = torch.rand(*state.track.shape, 2, generator=draw)
            if config.actions.kind == "discrete":
                action = (action[..., 0] * config.actions.n_actions).long()
            before, key = state, f"motion.kind: {config.motion.kind}"
            with naming_errors(key):
                state = simulation.step(state, action.to(state.track.device))
            fields = zip(
                State._fields[:-1], cast(list[Tensor], before), cast(list[Tensor], state), strict=False
            )
            for name, old, new in fields:
                checks.require(new.dtype == old.dtype, f"{key}: {name}", new.dtype, f"is not {old.dtype}")
                _check(f"{key}: {name}", new, old.shape)


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
    declared, messages, shape = feature_of(name), state.sent, state.track.shape
    values = server.features(messages, state.steps, [name])[name]
    width = values.shape[-1] if declared.width is None and values.dim() == 3 else declared.width
    _check(f"feature {name}", values, [*shape, *[width] * (width != 1)], declared.low, declared.high)
    if declared.scope != "local":
        return
    n = shape[-1]
    own = torch.eye(n, dtype=torch.bool, device=values.device).expand(len(values), n, n)
    known, older = (
        tree_map(lambda x: x.unsqueeze(1).expand(-1, n, *x.shape[1:]), each)
        for each in (messages, first.sent)
    )
    steps = state.steps.unsqueeze(-1).expand(-1, n)
    among_others = server.features(tree_where(own, known, older), steps, [name])[name]
    same = among_others.diagonal(0, 1, 2).movedim(-1, 1).float().allclose(values.float(), atol=_ROUNDING)
    problem = "changes with the messages of other UAVs: make it global, or read only the UAV's own"
    checks.require(same, f"feature {name}", "local", problem)


def _check(
    key: str, values: Tensor, shape: Sequence[int | None], low: float = -math.inf, high: float = math.inf
) -> None:
    """Require a shape, and finite values within bounds."""
    expected = [*shape]
    right = f"is not {expected} (worlds, UAVs, values): return this shape, or declare another width"
    checks.require([*values.shape] == expected, f"{key}: shape", [*values.shape], right)
    number = values.double()
    wrong = number[~((number >= low - _ROUNDING) & (number <= high + _ROUNDING) & number.isfinite())]
    bounds = f"between {low:g} and {high:g}, which it declares: scale it, or declare its bounds"
    should = f"is not {bounds if math.isfinite(low) else 'finite'}"
    checks.require(not len(wrong), key, f"{wrong[0].item() if len(wrong) else 0:g}", should)
