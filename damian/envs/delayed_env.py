"""A transformed environment that steps with its transforms as one compiled graph."""

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import Compose, Transform, TransformedEnv

from damian import keys
from damian.common import devices
from damian.common.compiling import CompiledMethods, world_options
from damian.common.tensors import where_rows
from damian.delays.scenario import ScenarioDelays
from damian.envs.forward import Assumed, Forward
from damian.envs.nodes import Drop
from damian.envs.uav_env import Outputs, UavEnv
from damian.server.layout import Layout
from damian.server.server import Server
from damian.transforms.base import Memory, StatefulTransform
from damian.transforms.entries import Entries, select_entries
from damian.transforms.history import ActionHistory
from damian.world.state import PackedState

_BASE = "base_env."
"""Begin of the keys of the base environment in a ``state_dict``."""


class DelayedEnv(TransformedEnv):
    """A ``TransformedEnv`` that steps a ``UavEnv`` and its transforms in one function, with equal
    results.

    ``step_fn`` and ``reset_fn`` are that function: pure, of the worlds and of the transforms'
    memories. All leading transforms of damian's step in it; those after them, and steps of some
    worlds only (TorchRL's ``_step``), go through TorchRL's hooks.
    """

    delays: ScenarioDelays
    """The samplers of what is late, as ``make_env`` has resolved them."""
    _compiled: CompiledMethods | None = None
    """The compiled methods; None if nothing is compiled."""

    @property
    def uav_env(self) -> UavEnv:
        """The ``UavEnv`` under the transforms."""
        return cast(UavEnv, self.base_env)

    @property
    def server(self) -> Server:
        """The server node that environment, transforms, replay storage and evaluation share."""
        return self.uav_env.server

    @property
    def layout(self) -> dict[str, Layout]:
        """What the columns of each observation mean, by the last part of its key.

        The keys are ``observation`` (with the past actions that ``ActionHistory`` appends),
        ``global_observation`` and ``privileged_observation``.
        """
        layouts = dict(self.uav_env.layout)
        for transform in cast(Compose, self.transform):
            if isinstance(transform, ActionHistory):
                for key in transform.in_keys:
                    name = keys.last_part(key)
                    spec = self.observation_spec[key]
                    layouts[name] = _with_past_actions(layouts[name], transform.steps, spec)
        return layouts

    def assume(self, policy: Assumed) -> None:
        """Say what every UAV is assumed to choose, where ``observation.forward`` flies late
        messages forward; nothing, if nothing is flown."""
        for transform in self.transform.modules():
            if isinstance(transform, Forward):
                transform.assumed = policy

    # Seeds, checkpoints and compiling.

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seed the worlds and the transforms, all from one seed."""
        for module in self._stateful_modules():
            module.set_seed(seed)
        return super().set_seed(seed, static_seed)

    def seed_worlds(self, seeds: Tensor) -> None:
        """Give every world [B] its own random streams: it evolves the same alone as among
        others."""
        self.uav_env.seed_worlds(seeds)
        for module in self._stateful_modules():
            module.seed_worlds(seeds)

    def state_dict(self, *args: Any, **kwargs: Any) -> OrderedDict[str, Any]:
        """The state of the transforms and of the environment under them; an equal one continues
        with it."""
        state = cast(OrderedDict[str, Any], super().state_dict(*args, **kwargs))
        self.base_env.state_dict(destination=state, prefix=kwargs.get("prefix", "") + _BASE)
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any], **kwargs: Any) -> None:  # type: ignore[override]
        """Load a state; one without the environment's, as TorchRL's collectors save it, leaves the
        worlds."""
        base = {
            k.removeprefix(_BASE): value for k, value in state_dict.items() if k.startswith(_BASE)
        }
        others = OrderedDict(
            (k, value) for k, value in state_dict.items() if not k.startswith(_BASE)
        )
        if base:
            self.base_env.load_state_dict(base, **kwargs)
            for module in self._stateful_modules():
                module.leave_episode()
        super().load_state_dict(others, **kwargs)

    def _stateful_modules(self) -> list[StatefulTransform]:
        return [
            module for module in self.transform.modules() if isinstance(module, StatefulTransform)
        ]

    def compile(self, cuda_graph: bool = True, **options: Any) -> "DelayedEnv":
        """Compile a step with its transforms as one graph, on a GPU as one CUDA graph.

        Args:
            cuda_graph: on a GPU, launch all kernels at once, for the memory of a state and a step.
                A step
                then changes the state in place: clone what ``state`` or ``state_dict`` have given.
            options: of ``torch.compile``, in place of ours.
        """
        options = options or world_options(self.uav_env.n_agents)
        methods = CompiledMethods(options, cuda_graph and self.uav_env.device.type == "cuda")
        object.__setattr__(self, "_compiled", methods)  # TransformedEnv's own is for specs
        return self

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """Draw actions as TorchRL does, but write them without a TensorDict in between, a tenth of
        a step."""
        if tensordict is None:
            return super().rand_action()
        for key in self.action_keys:
            tensordict.set(key, self.full_action_spec[key].rand())
        return tensordict

    # Pure functions of worlds and memories, which can be compiled.

    def step_fn(
        self, worlds: PackedState, memories: list[Memory], entries: Entries
    ) -> tuple[PackedState, list[Memory], Outputs]:
        """One step: inputs pass the transforms backwards, outputs forwards.

        ``entries`` are those that a policy has written, and those that it has read.
        """
        transforms = self._fused()
        changed = list(memories)
        for i, transform in reversed([*enumerate(transforms)]):
            changed[i], written = transform.on_action(changed[i], entries)
            entries = entries | written
        worlds, outputs = self.uav_env.step_fn(
            worlds,
            entries[keys.ACTION],
            entries.get(keys.ACTION_VALID),
            entries.get(keys.COMMAND),
        )
        for i, transform in enumerate(transforms):
            changed[i], written = transform.on_step(changed[i], outputs)
            outputs = outputs | written
        return worlds, changed, _without_dropped(outputs, transforms)

    def reset_fn(
        self, worlds: PackedState, memories: list[Memory], mask: Tensor
    ) -> tuple[PackedState, list[Memory], Outputs]:
        """Begin new episodes in the worlds of the mask [B] bool."""
        transforms = self._fused()
        changed = list(memories)
        worlds, outputs = self.uav_env.reset_fn(worlds, mask)
        for i, transform in enumerate(transforms):
            changed[i], written = transform.on_reset(
                changed[i], outputs, transform.expand_worlds(mask)
            )
            outputs = outputs | written
        return worlds, changed, _without_dropped(outputs, transforms)

    def step_and_reset_fn(
        self, worlds: PackedState, memories: list[Memory], entries: Entries
    ) -> tuple[PackedState, list[Memory], Outputs, Outputs]:
        """One step, and a reset of the worlds that it ends: also the outputs that begin the next
        step."""
        worlds, memories, outputs = self.step_fn(worlds, memories, entries)
        following = {key: value for key, value in outputs.items() if key != keys.REWARD}
        done = outputs[keys.DONE]
        if torch.compiler.is_compiling() or not devices.data_dependent(done.device) or done.any():
            mask = done.view(-1)
            worlds, memories, first = self.reset_fn(worlds, memories, mask)
            following |= {k: where_rows(mask, x, following[k]) for k, x in first.items()}
        return worlds, memories, outputs, following

    def _fused(self) -> list[StatefulTransform]:
        return self._split_transforms()[0]

    def _split_transforms(self) -> tuple[list[StatefulTransform], list[Transform]]:
        """The leading stateful transforms that step in one function, and every transform after
        them."""
        transforms: list[Any] = [*cast(Compose, self.transform)]
        others = (i for i, each in enumerate(transforms) if not isinstance(each, StatefulTransform))
        n = next(others, len(transforms))
        return transforms[:n], transforms[n:]

    # Methods that TorchRL calls.

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if "_step" in tensordict or "next" in tensordict:
            return super()._step(tensordict)
        fused, others = self._split_transforms()
        if others:
            tensordict = tensordict.clone(False)
            for transform in reversed(others):
                tensordict = transform._inv_call(tensordict)
        memories, entries = self._step_inputs(fused, tensordict)
        worlds, memories, outputs = self._compiled_fn("step_fn", *entries)(
            self.uav_env.worlds, memories, entries
        )
        self._store(fused, worlds, memories)
        result = self.uav_env.to_tensordict(outputs)
        for transform in others:
            result = transform._step(tensordict, result)
        return result

    @torch.no_grad()
    def _reset(self, tensordict: TensorDictBase | None = None, **options: Any) -> TensorDictBase:
        fused, others = self._split_transforms()
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or not all(transform.has_memory for transform in fused):
            return super()._reset(tensordict, **options)
        memories = [transform.memory for transform in fused]
        reset = self._compiled_fn("reset_fn")
        worlds, memories, outputs = reset(self.uav_env.worlds, memories, mask.view(-1))
        self._store(fused, worlds, memories)
        result = self.uav_env.to_tensordict(outputs)
        for transform in others:
            result = transform._reset(tensordict, result)
        return result

    @torch.no_grad()
    def _step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """As TorchRL's, in one graph; what a policy has written stays after a reset."""
        fused, others = self._split_transforms()
        partial = "_step" in tensordict or "next" in tensordict or tensordict.device != self.device
        if others or partial:
            return super()._step_and_maybe_reset(tensordict)
        self._assert_tensordict_shape(tensordict)
        env, (memories, entries) = self.uav_env, self._step_inputs(fused, tensordict)
        step = self._compiled_fn("step_and_reset_fn", *entries)
        worlds, memories, outputs, following = step(env.worlds, memories, entries)
        self._store(fused, worlds, memories)
        begins = _keep_others(tensordict, env.to_tensordict(following))
        return tensordict.set("next", env.to_tensordict(outputs)), begins

    def _compiled_fn(self, name: str, *variant: Any) -> Callable[..., Any]:
        """The pure function of this name, compiled if ``compile`` was called: a graph for each
        variant."""
        function = getattr(self, name)
        return (
            function
            if self._compiled is None
            else self._compiled.get(function, *self._fused(), *variant)
        )

    def _step_inputs(
        self, fused: list[StatefulTransform], tensordict: TensorDictBase
    ) -> tuple[list[Memory], Entries]:
        """The memories of the transforms, and the entries that they and the worlds read before a
        step."""
        memories = []
        entries = select_entries(tensordict, [keys.ACTION, keys.ACTION_VALID])
        for transform in fused:
            transform.require_memory()
            entries |= select_entries(tensordict, transform.action_keys)
            memories.append(transform.memory)
        return memories, entries

    def _store(
        self, fused: list[StatefulTransform], worlds: PackedState, memories: list[Memory]
    ) -> None:
        self.uav_env.worlds = worlds
        for transform, memory in zip(fused, memories, strict=True):
            transform.set_memory(memory)


def _with_past_actions(layout: Layout, n_actions: int, spec: TensorSpec) -> Layout:
    """A layout with the columns that an ``ActionHistory`` has appended, by the spec of the
    observation."""
    bounds = {}
    if isinstance(spec, Bounded):
        low = spec.low[..., layout.width :].amin()
        high = spec.high[..., layout.width :].amax()
        bounds = {"low": low.item(), "high": high.item()}
    shape = (n_actions, (spec.shape[-1] - layout.width) // n_actions)
    meaning = f"The latest {n_actions} actions of the UAV itself, scaled, the oldest first."
    return layout.appended("action_history", shape, meaning=meaning, **bounds)


def _without_dropped(outputs: Outputs, transforms: Sequence[StatefulTransform]) -> Outputs:
    """The outputs without those that a transform drops."""
    dropped = {key for each in transforms if isinstance(each, Drop) for key in each.dropped_keys}
    return (
        {key: value for key, value in outputs.items() if key not in dropped} if dropped else outputs
    )


def _keep_others(before: TensorDictBase, after: TensorDictBase) -> TensorDictBase:
    """Add to ``after`` the entries of ``before`` that it lacks, such as what the policy has
    written."""
    for name, value in before.items():
        if name not in after:
            after.set(name, value.copy() if isinstance(value, TensorDictBase) else value)
        elif isinstance(value, TensorDictBase):
            _keep_others(value, cast(TensorDictBase, after.get(name)))
    return after
