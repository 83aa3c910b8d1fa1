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
"""Function from steps [T, B], and the newest messages that the server can hold after each step, [T, B, N, M],
to the entries after the steps, by key.

``("next", "done")``, ``("next", "terminated")`` and ``("next", "truncated")`` [T, B, 1] must be among them.
"""

OBSERVATIONS = ("observation", "global_observation")
"""Entries of the agents that a step outputs and the next step reads."""


class BackupdateStorage(TimeStorage):
    """Keeps steps in order of time, and corrects them as late messages arrive.

    Whenever steps are written, the storage recomputes them, and the earlier steps that a late message may
    still concern, from all messages that have arrived by the last step. The entries that ``recompute``
    returns replace the stored ones; recomputed observations also replace those before the next step of the
    same episode. All other entries stay, such as the actor's observation, action and log-probability.

    The storage adds three entries: ``valid`` [T, B, 1], false where the episode had ended already, as the
    server knows now; ``reset_after`` [T, B, 1], true where the environment was reset (such a step is
    truncated if the task had not ended after all); ``(group, "backupdated")`` [T, B, N, 1], true where a late
    message replaced the one that the server held.

    Args:
        max_size: T times B; T must be at least the steps of a batch plus twice ``longest``.
        recompute: computes the entries that depend on messages (for UAVs ``server_recompute``).
        longest: longest delay of a message [steps].
        group: the TensorDict of the agents, which has ``message``, ``received``, ``delay``, ``age`` and,
            before and after the step, the observations that ``recompute`` returns.
        step_count_key: earlier steps of the episode, [T, B, 1] (``StepCounter``); 0 where it begins.
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
        """Write steps [T, B] at the indices ``cursor`` of the first dimension, and back-update.

        Raises:
            ValueError: the storage is too small for the batch, or a message is later than ``longest``.
        """
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
                f"up to {self.longest} steps: {needs} steps of {n_worlds} worlds need {needs * n_worlds}"
            )
        longest = int(data["next", self.group, "delay"].max())
        if longest > self.longest:
            raise ValueError(f"longest: a message takes {longest} steps, more than {self.longest} steps")

    def receive(self, world: Tensor, agent: Tensor, steps_ago: Tensor, message: Tensor) -> None:
        """Add messages from outside the environment, such as those of real UAVs, and back-update.

        The messages count as arriving after the latest stored step.

        Args:
            world: index of each sender's world, [K].
            agent: index of each sender in its world, [K].
            steps_ago: steps from the generation of each message to the latest stored step, [K].
            message: packed messages, [K, M].

        Raises:
            ValueError: a message is older than the longest delay, or than the stored steps.
        """
        oldest, newest = int(steps_ago.max()), int(steps_ago.min())
        reach = min(self.longest, cast(int, self._len_along_dim0) - 1)
        if newest < 0 or oldest > reach:
            raise ValueError(f"steps_ago: {newest} to {oldest} is not between 0 and {reach} steps")
        index = self.latest(oldest + 1).flip(0)[steps_ago]
        after = cast(TensorDictBase, self._storage["next", self.group])
        after["message"][index, world, agent] = message
        after["delay"][index, world, agent, 0] = steps_ago
        self.backupdate(oldest + 1)

    def backupdate(self, n_steps: int) -> None:
        """Correct the latest ``n_steps`` steps with all messages that have arrived by the last step."""
        # Earlier steps too, whose messages may be the newest ones of the steps to correct.
        index = self.latest(n_steps + self.longest)
        recomputed = self.recomputed(self._storage[index])
        rows = index[-n_steps:]
        for key, value in recomputed.items():
            self._storage.get(key)[rows] = value[-len(rows) :]
        self._bump_mutation_revision()

    def recomputed(self, steps: TensorDictBase) -> dict[NestedKey, Tensor]:
        """The corrected entries of consecutive steps [T, B], as the server knows after the last step."""
        group, begins = self.group, steps[self.step_count_key].squeeze(-1) == 0
        agents = cast(TensorDictBase, steps["next", group])
        log = MessageLog(
            sent=agents["message"],
            delay=agents["delay"].squeeze(-1),
            held=agents["received"],
            age=agents["age"].squeeze(-1).long(),
        )
        latest = latest_arrived(log)
        after = self.recompute(steps, latest)
        done, terminated, truncated = map(next_key, (keys.DONE, keys.TERMINATED, keys.TRUNCATED))
        reset = steps[keys.RESET_AFTER]
        after[truncated] = after[truncated] | (reset & ~after[terminated])
        after[done] = after[done] | reset
        already_ended = ~steps[keys.VALID][0].squeeze(-1) & ~begins[0]
        over = ended_before(after[done].squeeze(-1), begins, already_ended)
        no_previous = begins.clone()
        no_previous[0] = True  # the step before the first one is not among these steps
        before = {
            (group, name): _shift(after["next", group, name], steps[group, name], no_previous)
            for name in OBSERVATIONS
            if ("next", group, name) in after
        }
        replaced = (latest != log.held).any(-1, keepdim=True)
        return {**after, **before, (group, "backupdated"): replaced, keys.VALID: ~over.unsqueeze(-1)}


def _shift(after: Tensor, before: Tensor, no_previous: Tensor) -> Tensor:
    """Observations before each step [T, B, ...]: those after the previous step, or, where the mask
    ``no_previous`` [T, B] is true, ``before``."""
    previous = torch.cat([after[:1], after[:-1]])
    return torch.where(expand_mask(no_previous, before), before, previous)
