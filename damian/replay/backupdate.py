"""A replay-buffer storage that corrects stored steps as late messages arrive (paper, section 3.4)."""

from collections.abc import Callable
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from damian import keys
from damian.common.tensors import expand_mask
from damian.keys import next_key
from damian.replay.hindsight import MessageLog, ended_before, latest_arrived
from damian.replay.time_storage import TimeStorage

Recompute = Callable[[TensorDictBase, Tensor], dict[NestedKey, Tensor]]
"""From steps [T, B] and the newest messages known of each, [T, B, N, M]: entries after the step, by key.

``("next", "done")``, ``("next", "terminated")`` and ``("next", "truncated")`` [T, B, 1] must be among them.
"""

OBSERVATIONS = ("observation", "global_observation")
"""Entries of the agents that are output after a step and read before the next."""


class BackupdateStorage(TimeStorage):
    """Keeps steps in order of time, and corrects them as late messages arrive.

    Whenever steps are written, these and the earlier ones to which a message may still belong are recomputed
    from all messages that have arrived by the last step: the entries that ``recompute`` returns replace the
    stored ones, and observations among them also replace those before the next step of the same episode.
    Other entries, such as what the actor saw, its action and its log-probability, stay.

    Entries are added: ``valid`` [T, B, 1], false where the episode had ended already, as the server knows
    now; ``reset_after`` [T, B, 1], true where the environment was reset (if it was, but the task had not
    ended after all, the step is truncated); ``(group, "backupdated")`` [T, B, N, 1], true where a late
    message replaced the one that the server held.

    Args:
        max_size: T times B; T must be at least a batch's steps and twice ``longest``.
        recompute: entries that follow from messages (for UAVs ``server_recompute``).
        longest: longest delay of a message [steps].
        group: the TensorDict of the agents, which has ``message``, ``received``, ``delay``, ``age`` and,
            before and after the step, the observations that ``recompute`` returns.
        step_count_key: steps of the episode so far, [T, B, 1] (``StepCounter``); 0 where it begins.
        options: of ``LazyTensorStorage``.
    """

    def __init__(
        self,
        max_size: int,
        recompute: Recompute,
        longest: int,
        *,
        group: str = keys.AGENTS,
        step_count_key: NestedKey = keys.STEP_COUNT,
        **options: Any,
    ) -> None:
        super().__init__(max_size, **options)
        self.recompute, self.longest, self.group = recompute, longest, group
        self.step_count_key = step_count_key

    def set(  # type: ignore[override]
        self, cursor: Any, data: TensorDictBase, *, set_cursor: bool = True
    ) -> None:
        """Write steps [T, B] at these indices of the first dimension, and back-update."""
        self._check(data)
        done = data[next_key(keys.DONE)]
        data = data.copy().update({keys.VALID: torch.ones_like(done), keys.RESET_AFTER: done.clone()})
        delay = data["next", self.group, "delay"]
        data[self.group, "backupdated"] = torch.zeros_like(delay, dtype=torch.bool)
        super().set(cursor, data, set_cursor=set_cursor)
        self.backupdate(len(data) + self.longest)

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
            message: packed, [K, M].

        Raises:
            ValueError: a message is older than the longest delay, or than the stored steps.
        """
        oldest, least = int(steps_ago.max()), int(steps_ago.min())
        reach = min(self.longest, cast(int, self._len_along_dim0) - 1)
        if least < 0 or oldest > reach:
            raise ValueError(f"steps_ago: {least} to {oldest} is not between 0 and {reach}")
        index = self.latest(oldest + 1).flip(0)[steps_ago]
        after = cast(TensorDictBase, self._storage["next", self.group])
        after["message"][index, world, agent] = message
        after["delay"][index, world, agent, 0] = steps_ago
        self.backupdate(oldest + 1)

    def backupdate(self, n_steps: int) -> None:
        """Correct the latest steps with all messages that have arrived by the last one."""
        index = self.latest(n_steps + self.longest)  # messages sent before them may belong to them
        recomputed = self.recomputed(self._storage[index])
        rows = index[-n_steps:]
        for key, value in recomputed.items():
            self._storage.get(key)[rows] = value[-len(rows) :]
        self._bump_mutation_revision()

    def recomputed(self, steps: TensorDictBase) -> dict[NestedKey, Tensor]:
        """The corrected entries of consecutive steps [T, B], as known after the last of them."""
        group, begins = self.group, steps[self.step_count_key].squeeze(-1) == 0
        agents = cast(TensorDictBase, steps["next", group])
        log = MessageLog(
            sent=agents["message"],
            delay=agents["delay"].squeeze(-1),
            held=agents["received"],
            age=agents["age"].squeeze(-1).long(),
        )
        known = latest_arrived(log)
        after = self.recompute(steps, known)
        done, terminated, truncated = map(next_key, (keys.DONE, keys.TERMINATED, keys.TRUNCATED))
        reset = steps[keys.RESET_AFTER]
        after[truncated] = after[truncated] | (reset & ~after[terminated])
        after[done] = after[done] | reset
        already = ~steps[keys.VALID][0].squeeze(-1) & ~begins[0]
        over = ended_before(after[done].squeeze(-1), begins, already)
        first = begins.clone()
        first[0] = True  # the step before it is not among these
        before = {
            (group, name): _shift(after["next", group, name], steps[group, name], first)
            for name in OBSERVATIONS
            if ("next", group, name) in after
        }
        replaced = (known != log.held).any(-1, keepdim=True)
        return {**after, **before, (group, "backupdated"): replaced, keys.VALID: ~over.unsqueeze(-1)}


def _shift(after: Tensor, before: Tensor, first: Tensor) -> Tensor:
    """Observations before each step [T, B, ...]: those after the previous step, but not where ``first`` [T,
    B]."""
    previous = torch.cat([after[:1], after[:-1]])
    return torch.where(expand_mask(first, before), before, previous)
