"""A scenario's environment with its delays, losses and clocks: the one place that knows their order."""

import math
from collections.abc import Callable, Collection, Iterator
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, Transform, TransformedEnv

from damian.actions import ActionConfig
from damian.compiling import compiled
from damian.delays import law_of
from damian.env import Shown, UavEnv
from damian.scenario import ScenarioConfig
from damian.server import Server
from damian.state import Rows
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    Clock,
    CumulativeReward,
    ObservationDelay,
    RewardDelay,
    ServerNode,
)
from damian.transforms.stateful import Entries, Memory, Stateful, taken
from damian.world import draws

ACTION, REWARD, SEEN = ("agents", "action"), ("agents", "reward"), ("agents", "observation")


class DelayedEnv(TransformedEnv):
    """A ``TransformedEnv`` whose seed reaches its transforms, and whose step compiles as a whole."""

    _compiled: Callable[..., Any] | None = None

    @property
    def worlds(self) -> UavEnv:
        """The environment under the transforms.

        Raises:
            TypeError: it is another one, which has no worlds to seed or to compile.
        """
        if not isinstance(self.base_env, UavEnv):
            raise TypeError(f"this needs a UavEnv, not {type(self.base_env).__name__}")
        return self.base_env

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        for number, transform in enumerate(self._stateful()):
            transform.set_seed(None if seed is None else seed + 7919 * (number + 1))
        return super().set_seed(seed, static_seed)

    def seed_worlds(self, seeds: Tensor) -> None:
        """Give every world its own streams, [B] integers: alone it does what it does among others."""
        self.worlds.seed_worlds(seeds)
        for number, transform in enumerate(self._stateful()):
            transform.seed_worlds(draws.bits(seeds, torch.full_like(seeds, number)))

    def compile(self, **options: Any) -> "DelayedEnv":
        """Compile a step of ``UavEnv`` with its delays, as one graph, in place of TorchRL's bookkeeping.

        Args:
            options: for ``torch.compile``, in place of what suits a CPU.
        """
        _ = self.worlds  # refuses another environment
        object.__setattr__(self, "_compiled", compiled(self._whole_step, **options))
        return self

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._compiled is None or "_step" in tensordict or "next" in tensordict:
            return super()._step(tensordict)
        chain, later = self._split()
        if later:
            tensordict = tensordict.clone(False)
            for transform in reversed(later):
                tensordict = transform._inv_call(tensordict)
        shown = self._step_at_once(chain, tensordict)
        for transform in later:
            shown = transform._step(tensordict, shown)
        return shown

    @torch.no_grad()
    def _step_at_once(self, chain: list[Stateful], tensordict: TensorDictBase) -> TensorDictBase:
        env, entries = self.worlds, taken(tensordict, [ACTION])
        memories: list[Memory] = []
        for transform in chain:
            transform.check()
            entries |= taken(tensordict, transform.act_keys)
            memories.append(transform.memory)
        assert self._compiled is not None
        env.worlds, memories, shown = self._compiled(env.worlds, memories, entries)
        for transform, memory in zip(chain, memories, strict=True):
            transform.remember(memory)
        return env.tensordict(shown)

    def _whole_step(
        self, worlds: Rows, memories: list[Memory], entries: Entries
    ) -> tuple[Rows, list[Memory], Shown]:
        """A step of the worlds and of every transform in front of TorchRL's own; pure, as they are."""
        (chain, _), memories = self._split(), list(memories)
        for i, transform in reversed(list(enumerate(chain))):
            memories[i], changed = transform.act(memories[i], entries)
            entries = entries | changed
        worlds, shown = self.worlds.play(worlds, entries[ACTION], entries.get(("agents", "acts")))
        entries = flat(shown)
        for i, transform in enumerate(chain):
            memories[i], changed = transform.see(memories[i], entries)
            entries = entries | changed
            entries = {key: value for key, value in entries.items() if key not in transform.drop}
        return worlds, memories, nested(entries)

    def _split(self) -> tuple[list[Stateful], list[Transform]]:
        """The transforms in front that are ours, and all that come later."""
        transform = self.transform
        transforms: list[Any] = [*transform] if isinstance(transform, Compose) else [transform]
        n = next((i for i, t in enumerate(transforms) if not isinstance(t, Stateful)), len(transforms))
        return transforms[:n], transforms[n:]

    def _stateful(self) -> Iterator[Stateful]:
        for module in self.transform.modules():
            if isinstance(module, Stateful):
                yield module


def flat(shown: Shown) -> Entries:
    """Nested dictionaries as entries by key."""
    entries: Entries = {}
    for name, value in shown.items():
        if isinstance(value, dict):
            entries |= {(name, *([k] if isinstance(k, str) else k)): v for k, v in flat(value).items()}
        else:
            entries[name] = value
    return entries


def nested(entries: Entries) -> Shown:
    """Entries by key as nested dictionaries."""
    shown: Shown = {}
    for key, value in entries.items():
        *path, name = (key,) if isinstance(key, str) else cast(tuple[str, ...], key)
        level = shown
        for step in path:
            level = level.setdefault(step, {})
        level[name] = value
    return shown


def make_env(
    scenario: ScenarioConfig,
    num_worlds: int = 1,
    seed: int = 0,
    device: torch.device | str = "cpu",
    extras: Collection[str] = (),
) -> DelayedEnv:
    """The environment of a scenario with everything that is late in it.

    Args:
        scenario: with its ``delay`` and ``clock``.
        num_worlds: B.
        seed: of the worlds, and of the delays.
        device: where everything lives.
        extras: as in ``UavEnv``; with ``message`` also ``received`` (what the
            server holds), its ``age`` [steps], and the ``delay`` of what is sent, under ``"agents"``.

    Raises:
        InputError: the scenario asks for something impossible.
    """
    late = messages_are_late(scenario)
    shown = {*extras, "message"} if late else extras
    env = UavEnv(scenario, num_worlds, seed, device, shown, serves=not late)
    transforms = [*deciding(scenario), *(serving(scenario, env.server, extras) if late else [])]
    transforms += [*paying(scenario), *seeing(scenario)]
    delayed = DelayedEnv(env, Compose(*transforms))  # type: ignore[arg-type]
    delayed.set_seed(seed)
    return delayed


# The parts of the chain, in its order. What the policy chooses passes it backwards.


def deciding(scenario: ScenarioConfig) -> list[Transform]:
    """Actions on their way to the UAVs; one that was not ready when it chose has chosen nothing."""
    delay, clock = scenario.delay, scenario.clock
    if not is_late(delay.act, clock.dt) and clock.steps("agents") == 1:
        return []
    act = law_of(delay.act, "delay.act")
    hold = holding(scenario.actions)
    return [ActionDelay(act, ACTION, default=hold, dt=clock.dt, sent_key="ready", fresh_key="acts")]


def messages_are_late(scenario: ScenarioConfig) -> bool:
    """Does the server hold anything else than what was just sent."""
    return scenario.delay.loss > 0 or is_late(scenario.delay.obs, scenario.clock.dt)


def serving(scenario: ScenarioConfig, server: Server, extras: Collection[str]) -> list[Transform]:
    """Messages on their way to the server node, and what it makes of those that have arrived."""
    delay = scenario.delay
    uplink = ObservationDelay(
        law_of(delay.obs, "delay.obs"),
        [("agents", "message")],
        [("agents", "received")],
        loss=delay.loss,
        order=delay.order,
        dt=scenario.clock.dt,
        sent_key="talks",
        age_key="age" if "message" in extras else None,
        delay_key="delay" if "message" in extras else None,
    )
    unread = [] if "message" in extras else [("agents", k) for k in ("message", "received", "talks")]
    return [uplink, ServerNode(server, drop=unread, terms="reward_terms" in extras)]


def paying(scenario: ScenarioConfig) -> list[Transform]:
    """Rewards on their way."""
    delay, dt = scenario.delay, scenario.clock.dt
    late = [RewardDelay(law_of(delay.rew, "delay.rew"), REWARD, dt=dt)] if is_late(delay.rew, dt) else []
    window = delay.reward_window
    summed = [CumulativeReward(window, delay.reward_discount, REWARD)] if window > 1 else []
    return [*late, *summed]


def seeing(scenario: ScenarioConfig) -> list[Transform]:
    """When the server broadcasts, when the UAVs listen, and what they remember by themselves."""
    clock, n_actions = scenario.clock, scenario.delay.history
    transforms: list[Transform] = []
    if clock.steps("server") > 1:
        transforms.append(Clock(clock.steps("server"), [SEEN, ("agents", "global_observation")]))
    if clock.steps("agents") > 1:
        transforms.append(Clock(clock.steps("agents"), [SEEN], ready_key=("agents", "ready")))
    if n_actions:
        history = ActionHistory(
            n_actions,
            ACTION,
            append_to=SEEN,
            codes=action_codes(scenario.actions),
            default=holding(scenario.actions),
            recorded_key="ready",
        )
        transforms.append(history)
    return transforms


def is_late(law: Any, dt: float) -> bool:
    """Does a law, as a person writes it, delay anything."""
    return law_of(law).sampler(dt).certain != 0


def holding(actions: ActionConfig) -> int:
    """The action that holds the position, or the first one if there is none (discrete); distance 0."""
    discrete = actions.kind == "discrete" and 0.0 in actions.distances
    return actions.distances.index(0.0) * len(actions.headings) if discrete else 0


def action_codes(actions: ActionConfig) -> Tensor | None:
    """Discrete actions as an actor sees its past ones: distance and heading, each in [0, 1], [A, 2]."""
    if actions.kind == "continuous":
        return None  # they are just that
    distance, heading = actions.table().unbind(-1)
    return torch.stack([distance / distance.max(), (heading / (2 * math.pi)) % 1], -1)
