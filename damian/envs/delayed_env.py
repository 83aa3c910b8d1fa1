"""An environment with transforms that is seeded as one, and steps as one compiled graph."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, Transform, TransformedEnv

from damian import keys
from damian.common import counter_rng
from damian.common.compiling import compiled
from damian.common.tensors import expand_mask, tree_where
from damian.envs.uav_env import Outputs, UavEnv
from damian.server.server import Server
from damian.transforms.base import StatefulTransform
from damian.transforms.entries import Entries, Memory, drop_keys, select_entries
from damian.world.state import PackedState

_SEED_STRIDE = 7919
"""Between the seeds of two transforms."""


class DelayedEnv(TransformedEnv):
    """A ``TransformedEnv`` whose seed reaches its transforms, and that steps a ``UavEnv`` and them as a
    whole.

    It does what TorchRL does transform by transform, without a TensorDict in between, so that it compiles
    into one graph.
    """

    _compile_options: dict[str, Any] | None = None
    """For ``torch.compile``; None if nothing is compiled."""

    @property
    def uav_env(self) -> UavEnv:
        """The environment under the transforms.

        Raises:
            TypeError: it is another one, which has no worlds to seed or to compile.
        """
        if not isinstance(self.base_env, UavEnv):
            raise TypeError(f"this needs a UavEnv, not {type(self.base_env).__name__}")
        return self.base_env

    @property
    def server(self) -> Server:
        """The server node, the same for environment, transforms, storage and evaluation."""
        return self.uav_env.server

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seed every random stream; the next step must follow a reset, which counts as the first."""
        for number, transform in enumerate(self._stateful()):
            transform.set_seed(None if seed is None else seed + _SEED_STRIDE * (number + 1))
        return super().set_seed(seed, static_seed)

    def seed_worlds(self, seeds: Tensor) -> None:
        """Give every world its own random streams, [B] integers: it does the same alone as among others."""
        self.uav_env.seed_worlds(seeds)
        for number, transform in enumerate(self._stateful()):
            transform.seed_worlds(counter_rng.bits(seeds, torch.full_like(seeds, number)))

    def compile(self, **options: Any) -> "DelayedEnv":
        """Compile a step of ``UavEnv`` with its transforms as one graph.

        Args:
            options: for ``torch.compile``, instead of those that suit a CPU.
        """
        _ = self.uav_env  # refuses another environment
        for name, value in (("_compile_options", options), ("_graphs", {})):
            object.__setattr__(self, name, value)  # TransformedEnv's own __setattr__ is for specs
        return self

    def _function(self, *kind: Any) -> Callable[..., Any]:
        """The method of a name, or its graph: one for each set of transforms and entries, which no guard
        checks."""
        if self._compile_options is None:
            return getattr(self, kind[0])
        graphs = self.__dict__["_graphs"]
        if kind not in graphs:
            graphs[kind] = compiled(getattr(self, kind[0]), **self._compile_options)
        return graphs[kind]

    def __getstate__(self) -> dict[str, Any]:
        """Without the graphs: a copy compiles its own."""
        state = dict(cast(dict[str, Any], super().__getstate__()))
        return state | ({"_graphs": {}} if "_graphs" in state else {})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        partial = "_step" in tensordict or "next" in tensordict
        if partial or not isinstance(self.base_env, UavEnv):
            return super()._step(tensordict)
        ours, others = self._split()
        if others:
            tensordict = tensordict.clone(False)
            for transform in reversed(others):
                tensordict = transform._inv_call(tensordict)
        result = self._step_ours(ours, tensordict)
        for transform in others:
            result = transform._step(tensordict, result)
        return result

    @torch.no_grad()
    def _step_ours(self, ours: list[StatefulTransform], tensordict: TensorDictBase) -> TensorDictBase:
        """A step of the worlds and of the transforms that are ours."""
        env, entries = self.uav_env, select_entries(tensordict, [keys.ACTION, keys.ACTION_VALID])
        memories: list[Memory] = []
        for transform in ours:
            if not transform.has_memory:
                transform.check()  # raises, and says why
            entries |= select_entries(tensordict, transform.action_keys)
            memories.append(transform.memory)
        step = self._function("_whole_step", *ours, *entries)
        worlds, memories, outputs = step(env.worlds, memories, entries)
        for transform in ours:
            while (skipped := transform.skipped_worlds(outputs)) is not None and skipped.any():
                again = self._function("_further_step", *ours, *entries)
                worlds, memories, outputs = again(transform, worlds, memories, entries, outputs, skipped)
        env.worlds = worlds
        for transform, memory in zip(ours, memories, strict=True):
            transform.set_memory(memory)
        return env.to_tensordict(outputs)

    def _whole_step(
        self, worlds: PackedState, memories: list[Memory], entries: Entries, stepped: Tensor | None = None
    ) -> tuple[PackedState, list[Memory], Outputs]:
        """A step of the worlds and of the transforms that are ours; pure, as they are.

        If there is a mask [B], only its worlds send messages: the others will make this step once more, and
        messages are written in place.
        """
        (ours, _), memories = self._split(), list(memories)
        for i, transform in reversed(list(enumerate(ours))):
            memories[i], changed = transform.on_action(memories[i], entries)
            entries = entries | changed
        worlds, outputs = self.uav_env.step_fn(worlds, entries[keys.ACTION], entries.get(keys.ACTION_VALID))
        if stepped is not None:
            outputs = _mask_sent(stepped, ours, outputs)
        for i, transform in enumerate(ours):
            memories[i], changed = transform.on_step(memories[i], outputs)
            outputs = drop_keys(outputs | changed, transform.dropped_keys)
        return worlds, memories, outputs

    def _further_step(
        self,
        skipping: StatefulTransform,
        worlds: PackedState,
        memories: list[Memory],
        entries: Entries,
        outputs: Outputs,
        stepped: Tensor,
    ) -> tuple[PackedState, list[Memory], Outputs]:
        """One more step of the worlds of the mask [B], in which no agent is ready; the others stand still."""
        ours, _ = self._split()
        entries = entries | {
            key: outputs[key] for key in entries if key in outputs
        }  # flags such as ``ready``
        later, changed, after = self._whole_step(worlds, memories, entries, stepped)
        memories = [
            t.merge_worlds(old, new, stepped) for t, old, new in zip(ours, memories, changed, strict=True)
        ]
        return tree_where(stepped, later, worlds), memories, skipping.merge_steps(outputs, after, stepped)

    @torch.no_grad()
    def _reset(self, tensordict: TensorDictBase | None = None, **options: Any) -> TensorDictBase:
        ours, others = self._split()
        mask = None if tensordict is None else tensordict.get("_reset", None)
        ready = isinstance(self.base_env, UavEnv) and all(transform.has_memory for transform in ours)
        if mask is None or not ready:
            return super()._reset(tensordict, **options)
        env, memories = self.uav_env, [transform.memory for transform in ours]
        reset = self._function("_whole_reset", *ours)
        env.worlds, memories, outputs = reset(env.worlds, memories, mask)
        for transform, memory in zip(ours, memories, strict=True):
            transform.set_memory(memory)
        result = env.to_tensordict(outputs)
        for transform in others:
            result = transform._reset(tensordict, result)
        return result

    def _whole_reset(
        self, worlds: PackedState, memories: list[Memory], mask: Tensor
    ) -> tuple[PackedState, list[Memory], Outputs]:
        """A reset of the worlds of the mask [B, 1], and of every transform's memory of them; pure."""
        (ours, _), memories = self._split(), list(memories)
        worlds, outputs = self.uav_env.reset_fn(worlds, mask.view(-1))
        for i, transform in enumerate(ours):
            rows = transform.expand_worlds(mask)
            memories[i], changed = transform.on_reset(memories[i], outputs, rows)
            outputs = drop_keys(outputs | changed, transform.dropped_keys)
        return worlds, memories, outputs

    def _split(self) -> tuple[list[StatefulTransform], list[Transform]]:
        """The first transforms, as far as they are ours, and the others after them."""
        transform = self.transform
        transforms: list[Any] = [*transform] if isinstance(transform, Compose) else [transform]
        ours = (i for i, t in enumerate(transforms) if not isinstance(t, StatefulTransform))
        n = next(ours, len(transforms))
        return transforms[:n], transforms[n:]

    def _stateful(self) -> Iterator[StatefulTransform]:
        for module in self.transform.modules():
            if isinstance(module, StatefulTransform):
                yield module


def _mask_sent(stepped: Tensor, transforms: Sequence[StatefulTransform], outputs: Outputs) -> Outputs:
    """The outputs, in which only the worlds of the mask [B] send messages."""
    flags = [transform.sent_key for transform in transforms if transform.sent_key in outputs]
    return outputs | {key: outputs[key] & expand_mask(stepped, outputs[key]) for key in flags}
