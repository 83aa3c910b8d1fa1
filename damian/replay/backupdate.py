"""A replay-buffer storage that puts late messages in their place (SPEC 4, back-updating)."""

from collections.abc import Callable
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage

from damian.replay.hindsight import Mail, hindsight, over_before
from damian.server.features import Snapshot
from damian.server.server import Server

Recompute = Callable[[TensorDictBase, Tensor], dict[NestedKey, Tensor]]
"""From steps [T, B] and what was known after each, [T, B, N, F]: the entries after the step, corrected."""


SEEN = ("observation", "global_observation")
"""Entries of the agents that are shown after a step and before the next."""


class TimeStorage(LazyTensorStorage):
    """Keeps steps in order of time, [T, B].

    The writer must be a round robin (TorchRL's default) over steps of the same B worlds.

    Args:
        max_size: steps of worlds, T times B.
        options: of ``LazyTensorStorage``.
    """

    def __init__(self, max_size: int, **options: Any) -> None:
        super().__init__(max_size, ndim=2, **options)

    @property
    def steps(self) -> TensorDictBase:
        """All there is room for, [T, B], not in order: see ``latest``."""
        return cast(TensorDictBase, self._storage)

    def latest(self, n_steps: int | None = None) -> Tensor:
        """Places of the latest steps, or of all, in order of time, [min(n_steps, T)]."""
        stored = cast(int, self._len_along_dim0)
        n_steps = stored if n_steps is None else min(n_steps, stored)
        last = int(torch.as_tensor(self._last_cursor).view(-1)[-1])
        return torch.arange(last - n_steps + 1, last + 1, device=self.device) % stored


class BackupdateStorage(TimeStorage):
    """Keeps steps in order of time, and corrects them as late messages arrive.

    Whenever steps are written, the latest of them and those before to which a message may still have
    belonged are seen again with all that has arrived by the last one: what follows from the messages (the
    entries that ``recompute`` returns) is replaced, and so are observations among them at the next step of
    the same episode. What is not among them, such as what the actor saw, did, and with which probability,
    stays.

    Entries are added: ``valid`` [T, B, 1], false where the episode had ended already as one knows now;
    ``cut`` [T, B, 1], true where the environment was really reset (where it was, but the task had not ended
    after all, the step is truncated); ``(group, "backupdated")`` [T, B, N, 1], true where a message that
    came late took the place of what was held.

    Args:
        max_size: steps of worlds, T times B; T must be at least a batch's steps and twice ``longest``.
        recompute: what follows from messages (``server_view``).
        longest: largest delay of a message [steps].
        group: the TensorDict of the agents, with ``message``, ``received``, ``delay``, ``age`` and
            ``global_observation``.
        begins_key: steps of the episode so far, [T, B, 1] (``StepCounter``); 0 where it begins.
        options: of ``LazyTensorStorage``.
    """

    def __init__(
        self,
        max_size: int,
        recompute: Recompute,
        longest: int,
        *,
        group: str = "agents",
        begins_key: NestedKey = "step_count",
        **options: Any,
    ) -> None:
        super().__init__(max_size, **options)
        self.recompute, self.longest, self.group, self.begins_key = recompute, longest, group, begins_key

    def set(  # type: ignore[override]
        self, cursor: Any, data: TensorDictBase, *, set_cursor: bool = True
    ) -> None:
        """Write steps [T, B] at these places of the first dimension, and look back."""
        self._check(data)
        done = data["next", "done"]
        data = data.copy().update({"valid": torch.ones_like(done), "cut": done.clone()})
        delay = data["next", self.group, "delay"]
        data[self.group, "backupdated"] = torch.zeros_like(delay, dtype=torch.bool)
        super().set(cursor, data, set_cursor=set_cursor)
        self.look_back(len(data) + self.longest)

    def _check(self, data: TensorDictBase) -> None:
        needs, n_worlds = len(data) + 2 * self.longest, data.shape[1]
        if self.max_size < needs * n_worlds:
            raise ValueError(
                f"max_size: {self.max_size} is too little for batches of {len(data)} steps and delays of "
                f"up to {self.longest}: {needs} steps of {n_worlds} worlds are {needs * n_worlds}"
            )
        longest = int(data["next", self.group, "delay"].max())
        if longest > self.longest:
            raise ValueError(f"longest: a message takes {longest} steps, more than {self.longest}")

    def receive(self, world: Tensor, agent: Tensor, steps_ago: Tensor, message: Tensor) -> None:
        """Take messages from elsewhere, such as real UAVs, that have arrived after the latest step.

        Args:
            world: of the senders, [K].
            agent: likewise, [K].
            steps_ago: when each was generated, in steps before the latest, [K].
            message: [K, F].

        Raises:
            ValueError: one is older than the storage looks back.
        """
        oldest, least = int(steps_ago.max()), int(steps_ago.min())
        known = min(self.longest, cast(int, self._len_along_dim0) - 1)
        if least < 0 or oldest > known:
            raise ValueError(f"steps_ago: {least} to {oldest} is not between 0 and {known}")
        place = self.latest(oldest + 1).flip(0)[steps_ago]
        after = cast(TensorDictBase, self._storage["next", self.group])
        after["message"][place, world, agent] = message
        after["delay"][place, world, agent, 0] = steps_ago
        self.look_back(oldest + 1)

    def look_back(self, n_steps: int) -> None:
        """Correct the latest steps with all that has arrived by the last one."""
        index = self.latest(n_steps + self.longest)  # what was sent before them may belong to them
        corrected = self.corrected(self._storage[index])
        rows = index[-n_steps:]
        for key, value in corrected.items():
            self._storage.get(key)[rows] = value[-len(rows) :]
        self._bump_mutation_revision()

    def corrected(self, steps: TensorDictBase) -> dict[NestedKey, Tensor]:
        """The entries of consecutive steps [T, B] as they are known after the last of them."""
        group, begins = self.group, steps[self.begins_key].squeeze(-1) == 0
        after = cast(TensorDictBase, steps["next", group])
        mail = Mail(
            sent=after["message"],
            delay=after["delay"].squeeze(-1),
            held=after["received"],
            age=after["age"].squeeze(-1).long(),
        )
        beliefs = hindsight(mail)
        after = self.recompute(steps, beliefs)
        cut, terminated = steps["cut"], after["next", "terminated"]
        after["next", "truncated"] = after["next", "truncated"] | (cut & ~terminated)
        after["next", "done"] = after["next", "done"] | cut
        already = ~steps["valid"][0].squeeze(-1) & ~begins[0]
        over = over_before(after["next", "done"].squeeze(-1), begins, already)
        began = begins.clone()
        began[0] = True  # the step before it is not at hand
        before = {
            (group, name): _one_later(after["next", group, name], steps[group, name], began)
            for name in SEEN
            if ("next", group, name) in after
        }
        replaced = (beliefs != mail.held).any(-1, keepdim=True)
        return {**after, **before, (group, "backupdated"): replaced, "valid": ~over.unsqueeze(-1)}


def _one_later(after: Tensor, seen: Tensor, began: Tensor) -> Tensor:
    """What was seen before each step [T, B, ...]: what is known after the one before, but at a beginning."""
    before = torch.cat([after[:1], after[:-1]])
    return torch.where(began.view(*began.shape, *[1] * (seen.dim() - 2)), seen, before)


def server_view(server: Server, terms: bool = False, actor: bool = False) -> Recompute:
    """What the server node makes of messages, for a ``BackupdateStorage``.

    Args:
        server: of the environment.
        terms: correct ``reward_terms`` too.
        actor: and what the server tells the actors, in front of what they remember by themselves.
    """

    def recompute(steps: TensorDictBase, beliefs: Tensor) -> dict[NestedKey, Tensor]:
        elapsed, over = steps["next", "step_count"].squeeze(-1), steps.get(("next", "source_over"), None)
        served = server.serve(Snapshot.unpack(beliefs), elapsed, over)
        entries: dict[NestedKey, Tensor] = {
            ("next", "agents", "global_observation"): served.global_observation,
            ("next", "agents", "reward"): served.reward.unsqueeze(-1),
        }
        if actor:
            message = steps["next", "agents", "message"]
            own = server.config.observation.own
            told = server.informed(beliefs, message, elapsed) if own else served.observation
            seen = steps["next", "agents", "observation"]
            entries["next", "agents", "observation"] = torch.cat([told, seen[..., told.shape[-1] :]], -1)
        if terms:
            entries |= {("next", "agents", "reward_terms", k): v for k, v in served.terms.items()}
        return entries | {("next", k): v for k, v in served.status.entries().items()}

    return recompute
