"""A transformed environment that steps with its transforms as one compiled graph."""

from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, Transform, TransformedEnv

from damian import keys
from damian.common import devices
from damian.common.compiling import CompiledMethods
from damian.common.tensors import expand_mask, tree_where
from damian.envs.uav_env import Outputs, UavEnv
from damian.server.server import Server
from damian.transforms.base import Entries, Memory, StatefulTransform, act, begin, observe, select_entries
from damian.transforms.hold import SkipUntilReady
from damian.world.state import PackedState

_BASE = "base_env."
"""Begin of the keys of the base environment in a ``state_dict``."""


class DelayedEnv(TransformedEnv):
    """A ``TransformedEnv`` that steps a ``UavEnv`` and its transforms in one function, with equal results."""

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

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seed the worlds and the transforms, all from one seed."""
        for module in self.transform.modules():
            if isinstance(module, StatefulTransform):
                module.set_seed(seed)
        return super().set_seed(seed, static_seed)

    def seed_worlds(self, seeds: Tensor) -> None:
        """Give every world [B] its own random streams: it evolves the same alone as among others."""
        self.uav_env.seed_worlds(seeds)
        for module in self.transform.modules():
            if isinstance(module, StatefulTransform):
                module.seed_worlds(seeds)

    def state_dict(self, *args: Any, **kwargs: Any) -> OrderedDict[str, Any]:
        """The state of the transforms and of the environment under them; an equal one continues with it."""
        state = cast(OrderedDict[str, Any], super().state_dict(*args, **kwargs))
        self.base_env.state_dict(destination=state, prefix=kwargs.get("prefix", "") + _BASE)
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any], **kwargs: Any) -> None:  # type: ignore[override]
        """Load a state; one without the environment's, as TorchRL's collectors save it, leaves the worlds."""
        base = {k.removeprefix(_BASE): value for k, value in state_dict.items() if k.startswith(_BASE)}
        others = OrderedDict((k, value) for k, value in state_dict.items() if not k.startswith(_BASE))
        if base:
            self.base_env.load_state_dict(base, **kwargs)
            for module in self.transform.modules():
                if isinstance(module, StatefulTransform):
                    module.leave_episode()
        super().load_state_dict(others, **kwargs)

    def compile(self, **options: Any) -> "DelayedEnv":
        """Compile a step with its transforms as one graph; ``options`` are for ``torch.compile``."""
        object.__setattr__(self, "_compiled", CompiledMethods(options))  # TransformedEnv's own is for specs
        return self

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """Draw actions as TorchRL does, but write them without a TensorDict in between, a tenth of a step."""
        if tensordict is None:
            return super().rand_action()
        for key in self.action_keys:
            tensordict.set(key, self.full_action_spec[key].rand())
        return tensordict

    def _method(self, name: str, *variant: Any) -> Callable[..., Any]:
        """The method of this name, compiled if ``compile`` was called: a graph for each variant."""
        method = getattr(self, name)
        return method if self._compiled is None else self._compiled.get(method, *variant)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if "_step" in tensordict or "next" in tensordict:
            return super()._step(tensordict)
        stateful, others = self._split_transforms()
        if others:
            tensordict = tensordict.clone(False)
            for transform in reversed(others):
                tensordict = transform._inv_call(tensordict)
        result = self._step_stateful(stateful, tensordict)
        for transform in others:
            result = transform._step(tensordict, result)
        return result

    @torch.no_grad()
    def _step_stateful(self, stateful: list[StatefulTransform], tensordict: TensorDictBase) -> TensorDictBase:
        """Step the worlds and the leading stateful transforms."""
        env, (memories, entries) = self.uav_env, self._step_inputs(stateful, tensordict)
        step = self._method("_whole_step", *stateful, *entries)
        worlds, memories, outputs = step(env.worlds, memories, entries)
        skipping = next((each for each in stateful if isinstance(each, SkipUntilReady)), None)
        while skipping is not None and (skipped := skipping.skipped_worlds(outputs)).any():
            step = self._method("_further_step", *stateful, *entries)
            worlds, memories, outputs = step(skipping, worlds, memories, entries, outputs, skipped)
        self._store(stateful, worlds, memories)
        return env.to_tensordict(outputs)

    def _step_inputs(
        self, stateful: list[StatefulTransform], tensordict: TensorDictBase
    ) -> tuple[list[Memory], Entries]:
        """The memories of the transforms, and the entries that they and the worlds read before a step."""
        memories, entries = [], select_entries(tensordict, [keys.ACTION, keys.ACTION_VALID])
        for transform in stateful:
            transform.check()
            entries |= select_entries(tensordict, transform.action_keys)
            memories.append(transform.memory)
        return memories, entries

    def _store(self, stateful: list[StatefulTransform], worlds: PackedState, memories: list[Memory]) -> None:
        self.uav_env.worlds = worlds
        for transform, memory in zip(stateful, memories, strict=True):
            transform.set_memory(memory)

    def _whole_step(
        self, worlds: PackedState, memories: list[Memory], entries: Entries, stepped: Tensor | None = None
    ) -> tuple[PackedState, list[Memory], Outputs]:
        """One step, in the worlds ``stepped`` [B] or all, of worlds and stateful transforms; pure."""
        stateful, _ = self._split_transforms()
        mask: Entries = {} if stepped is None else {keys.STEPPED: stepped}
        memories, entries = act(stateful, memories, entries | mask)
        worlds, outputs = self.uav_env.step_fn(worlds, entries[keys.ACTION], entries.get(keys.ACTION_VALID))
        return worlds, *observe(stateful, memories, outputs, mask)

    def _further_step(
        self,
        skipping: SkipUntilReady,
        worlds: PackedState,
        memories: list[Memory],
        entries: Entries,
        outputs: Outputs,
        stepped: Tensor,
    ) -> tuple[PackedState, list[Memory], Outputs]:
        """One more step of the worlds of the mask ``stepped`` [B], which have no ready agent; others stay."""
        stateful, _ = self._split_transforms()
        # Flags such as ``ready`` are those after the latest step.
        entries = entries | {key: outputs[key] for key in entries if key in outputs}
        new_worlds, new_memories, new_outputs = self._whole_step(worlds, memories, entries, stepped)
        memories = [
            transform.merge_worlds(old, new, stepped)
            for transform, old, new in zip(stateful, memories, new_memories, strict=True)
        ]
        merged = skipping.merge_steps(outputs, new_outputs, stepped)
        return tree_where(stepped, new_worlds, worlds), memories, merged

    @torch.no_grad()
    def _reset(self, tensordict: TensorDictBase | None = None, **options: Any) -> TensorDictBase:
        stateful, others = self._split_transforms()
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or not all(transform.has_memory for transform in stateful):
            return super()._reset(tensordict, **options)
        env, memories = self.uav_env, [transform.memory for transform in stateful]
        reset = self._method("_whole_reset", *stateful)
        worlds, memories, outputs = reset(env.worlds, memories, mask)
        self._store(stateful, worlds, memories)
        result = env.to_tensordict(outputs)
        for transform in others:
            result = transform._reset(tensordict, result)
        return result

    def _whole_reset(
        self, worlds: PackedState, memories: list[Memory], mask: Tensor
    ) -> tuple[PackedState, list[Memory], Outputs]:
        """Reset the worlds of the mask [B, 1] and the leading stateful transforms; a pure function."""
        stateful, _ = self._split_transforms()
        worlds, outputs = self.uav_env.reset_fn(worlds, mask.view(-1))
        return worlds, *begin(stateful, memories, outputs, mask)

    @torch.no_grad()
    def _step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """As TorchRL's, in one graph; what a policy has written stays after a reset."""
        stateful, others = self._split_transforms()
        partial = "_step" in tensordict or "next" in tensordict or tensordict.device != self.device
        if others or partial or _may_skip(stateful):
            return super()._step_and_maybe_reset(tensordict)
        self._assert_tensordict_shape(tensordict)
        env, (memories, entries) = self.uav_env, self._step_inputs(stateful, tensordict)
        step = self._method("_whole_step_and_reset", *stateful, *entries)
        worlds, memories, outputs, begin = step(env.worlds, memories, entries)
        self._store(stateful, worlds, memories)
        following = _keep_others(tensordict, env.to_tensordict(begin))
        tensordict.set("next", env.to_tensordict(outputs))
        return tensordict, following

    def _whole_step_and_reset(
        self, worlds: PackedState, memories: list[Memory], entries: Entries
    ) -> tuple[PackedState, list[Memory], Outputs, Outputs]:
        """One step, and a reset of the worlds that it ends: also the outputs that begin the next step."""
        worlds, memories, outputs = self._whole_step(worlds, memories, entries)
        begin = {key: value for key, value in outputs.items() if key != keys.REWARD}
        done = outputs[keys.DONE]
        if torch.compiler.is_compiling() or not devices.data_dependent(done.device) or done.any():
            worlds, memories, first = self._whole_reset(worlds, memories, done)
            mask = done.view(-1)
            begin |= {key: torch.where(expand_mask(mask, new), new, begin[key]) for key, new in first.items()}
        return worlds, memories, outputs, begin

    def _split_transforms(self) -> tuple[list[StatefulTransform], list[Transform]]:
        """The leading stateful transforms that step in one function, and every transform after them."""
        transform = self.transform
        transforms: list[Any] = [*transform] if isinstance(transform, Compose) else [transform]
        n = next(
            (i for i, t in enumerate(transforms) if not isinstance(t, StatefulTransform)), len(transforms)
        )
        stateful, others = transforms[:n], transforms[n:]
        if _may_skip(stateful):
            n = next((i for i, t in enumerate(stateful) if t.sees_merged_steps_only), len(stateful))
            stateful, others = stateful[:n], [*stateful[n:], *others]
        return stateful, others


def _may_skip(transforms: list[StatefulTransform]) -> bool:
    """Does any of the transforms make a step last longer in some worlds?"""
    return any(isinstance(each, SkipUntilReady) for each in transforms)


def _keep_others(before: TensorDictBase, after: TensorDictBase) -> TensorDictBase:
    """Add to ``after`` the entries of ``before`` that it lacks, such as what the policy has written."""
    for name, value in before.items():
        if name not in after:
            after.set(name, value.copy() if isinstance(value, TensorDictBase) else value)
        elif isinstance(value, TensorDictBase):
            _keep_others(value, cast(TensorDictBase, after.get(name)))
    return after
