"""An environment with a chain of transforms that is seeded as one, and steps as one compiled graph."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, Transform, TransformedEnv

from damian.common import counter_rng
from damian.common.compiling import compiled
from damian.envs.uav_env import Shown, UavEnv
from damian.transforms.base import Entries, Memory, Stateful, taken, wide
from damian.transforms.skip_until_ready import FastForward
from damian.world.state import Rows, where

ACTION, ACTS = ("agents", "action"), ("agents", "acts")


class DelayedEnv(TransformedEnv):
    """A ``TransformedEnv`` whose seed reaches its transforms, and that steps a ``UavEnv`` as a whole.

    It does what TorchRL does transform by transform, without building a TensorDict in between, and so that it
    compiles into one graph.
    """

    _options: dict[str, Any] | None = None
    """For ``torch.compile``; None if nothing is compiled."""

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
        """Seed everything that is drawn; the next reset, which must come before a step, is the first."""
        for number, transform in enumerate(self._stateful()):
            transform.set_seed(None if seed is None else seed + 7919 * (number + 1))
        return super().set_seed(seed, static_seed)

    def seed_worlds(self, seeds: Tensor) -> None:
        """Give every world its own streams, [B] integers: alone it does what it does among others."""
        self.worlds.seed_worlds(seeds)
        for number, transform in enumerate(self._stateful()):
            transform.seed_worlds(counter_rng.bits(seeds, torch.full_like(seeds, number)))

    def compile(self, **options: Any) -> "DelayedEnv":
        """Compile a step of ``UavEnv`` with its delays, as one graph, in place of TorchRL's bookkeeping.

        Args:
            options: for ``torch.compile``, in place of what suits a CPU.
        """
        _ = self.worlds  # refuses another environment
        for name, value in (("_options", options), ("_graphs", {})):
            object.__setattr__(self, name, value)  # TorchRL's own is for specs
        return self

    def _function(self, *kind: Any) -> Callable[..., Any]:
        """The function of a name, or its graph, one for each chain and set of entries: no guard sees them."""
        if self._options is None:
            return getattr(self, kind[0])
        graphs = self.__dict__["_graphs"]
        if kind not in graphs:
            graphs[kind] = compiled(getattr(self, kind[0]), **self._options)
        return graphs[kind]

    def __getstate__(self) -> dict[str, Any]:
        """Without the graphs: a copy compiles its own."""
        state = dict(cast(dict[str, Any], super().__getstate__()))
        return state | ({"_graphs": {}} if "_graphs" in state else {})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        plain = "_step" in tensordict or "next" in tensordict
        if plain or not isinstance(self.base_env, UavEnv):
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
        env, entries = self.worlds, taken(tensordict, [ACTION, ACTS])
        memories: list[Memory] = []
        for transform in chain:
            if not transform.begun:
                transform.check()  # says what is wrong
            entries |= taken(tensordict, transform.act_keys)
            memories.append(transform.memory)
        step = self._function("_whole_step", *chain, *entries)
        worlds, memories, shown = step(env.worlds, memories, entries)
        skip = next((transform for transform in chain if isinstance(transform, FastForward)), None)
        if skip is not None:
            further, seen = self._function("_further_step", *chain, *entries), flat(shown)
            while (moves := skip.idle(seen)).any():
                worlds, memories, seen = further(skip, worlds, memories, entries, seen, moves)
            shown = nested(seen)
        env.worlds = worlds
        for transform, memory in zip(chain, memories, strict=True):
            transform.remember(memory)
        return env.tensordict(shown)

    def _whole_step(
        self, worlds: Rows, memories: list[Memory], entries: Entries, moves: Tensor | None = None
    ) -> tuple[Rows, list[Memory], Shown]:
        """A step of the worlds and of every transform in front of TorchRL's own; pure, as they are.

        Only the worlds of the mask [B] show that they send anything, if there is one: the others will make
        this step once more, and what they send now, which is written in place, they may not send then.
        """
        (chain, _), memories = self._split(), list(memories)
        for i, transform in reversed(list(enumerate(chain))):
            memories[i], changed = transform.act(memories[i], entries)
            entries = entries | changed
        worlds, shown = self.worlds.play(worlds, entries[ACTION], entries.get(ACTS))
        entries = flat(shown) if moves is None else sent_by(moves, chain, flat(shown))
        for i, transform in enumerate(chain):
            memories[i], changed = transform.see(memories[i], entries)
            entries = without(entries | changed, transform.drop)
        return worlds, memories, nested(entries)

    def _further_step(
        self,
        skip: FastForward,
        worlds: Rows,
        memories: list[Memory],
        entries: Entries,
        seen: Entries,
        moves: Tensor,
    ) -> tuple[Rows, list[Memory], Entries]:
        """One more step of the worlds of the mask [B], in which nobody is ready; the others stand still."""
        chain, _ = self._split()
        entries = entries | {key: seen[key] for key in entries if key in seen}  # nobody is ready any more
        later, changed, shown = self._whole_step(worlds, memories, entries, moves)
        memories = [t.only(old, new, moves) for t, old, new in zip(chain, memories, changed, strict=True)]
        return where(moves, later, worlds), memories, skip.longer(seen, flat(shown), moves)

    @torch.no_grad()
    def _reset(self, tensordict: TensorDictBase | None = None, **options: Any) -> TensorDictBase:
        chain, later = self._split()
        mask = None if tensordict is None else tensordict.get("_reset", None)
        whole = isinstance(self.base_env, UavEnv) and all(transform.begun for transform in chain)
        if mask is None or not whole:
            return super()._reset(tensordict, **options)
        env, memories = self.worlds, [transform.memory for transform in chain]
        reset = self._function("_whole_reset", *chain)
        env.worlds, memories, shown = reset(env.worlds, memories, mask)
        for transform, memory in zip(chain, memories, strict=True):
            transform.remember(memory)
        began = env.tensordict(shown)
        for transform in later:
            began = transform._reset(tensordict, began)
        return began

    def _whole_reset(
        self, worlds: Rows, memories: list[Memory], mask: Tensor
    ) -> tuple[Rows, list[Memory], Shown]:
        """A reset of some worlds, [B, 1], and of what every transform remembers of them; pure."""
        (chain, _), memories = self._split(), list(memories)
        worlds, shown = self.worlds.begin(worlds, mask.view(-1))
        entries = flat(shown)
        for i, transform in enumerate(chain):
            memories[i], changed = transform.begin(memories[i], entries, transform.rows_of(mask))
            entries = without(entries | changed, transform.drop)
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


def sent_by(moves: Tensor, chain: Sequence[Stateful], entries: Entries) -> Entries:
    """The entries, but only the worlds of the mask [B] send anything."""
    flags = [transform.sent_key for transform in chain if transform.sent_key in entries]
    return entries | {key: entries[key] & wide(moves, entries[key]) for key in flags}


def without(entries: Entries, keys: Sequence[NestedKey]) -> Entries:
    """All other entries."""
    return {key: value for key, value in entries.items() if key not in keys}


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
