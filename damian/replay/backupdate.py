"""A replay-buffer storage that corrects stored steps as late messages arrive
(paper, section 3.4)."""

from collections.abc import Callable, Collection, Sequence
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.envs import Transform

from damian import keys
from damian.common import checks
from damian.common.errors import InputError
from damian.common.tensors import expand_mask
from damian.keys import next_key
from damian.replay.hindsight import ended_before, latest_arrived
from damian.replay.time_storage import TimeStorage
from damian.transforms.base import Correction, StatefulTransform, leaf_transforms
from damian.transforms.entries import Entries, sibling_key

Recompute = Callable[[TensorDictBase, Tensor], Entries]
"""Function from steps [T, B], and the newest message that the receiver can hold after each of them,
to new values of entries by key, as ``{("next", "reward"): reward}``; the flags that end an episode:
all, or none."""

ENDS = tuple(map(next_key, keys.ENDS))
"""Keys of the flags that end an episode after a step."""


def corrections_of(transform: Transform, recomputed: Collection[NestedKey]) -> list[Correction]:
    """The corrections of ``recomputed`` entries and rewards by a transform or a ``Compose``, in
    order."""
    leaves = [leaf for leaf in leaf_transforms(transform) if isinstance(leaf, StatefulTransform)]
    found = (leaf.hindsight(recomputed) for leaf in leaves)
    return [correction for correction in found if correction is not None]


class BackupdateStorage(TimeStorage):
    """Keeps steps in order of time, and corrects them as late messages arrive
    (docs/backupdating.md).

    Whenever steps are written, the storage recomputes them, and the earlier steps that a late
    message may still concern, from all messages that have arrived by the last step. The entries
    that ``recompute`` returns replace the stored ones, once ``corrections`` have changed them as
    the transforms after the receiver did. Where the steps have such an entry before the step too,
    as observations are, it becomes that after the previous step of the same episode; the ends
    before a step stay, and so do all other entries.

    The storage adds: ``valid`` [T, B, 1], false where the episode had ended already, as the
    receiver knows now; ``reset_after`` [T, B, 1], true where the environment was reset
    (such a step is truncated if the task had not ended after all); ``backupdated`` beside
    ``delay_key``, true where late messages have changed the stored reward
    (without messages: where a late reward has been paid); and the messages of ``hindsight_key``
    with their ages.

    The entries of messages are at the root (one sender in each world: [T, B, M], delay and age [T,
    B, 1]) or in a group of N agents ([T, B, N, M], delay and age [T, B, N, 1]).

    Args:
        max_size: T times B; T must be at least the steps of a batch plus twice ``longest`` plus
            ``lookback``.
        recompute: computes the entries that depend on messages (``server_recompute``); None if only
            rewards are late, which ``corrections`` then credit.
        longest: longest delay of a message or of a reward [steps].
        corrections: for what transforms after the receiver do to these entries, in order
            (``corrections_of``).
        message_key, received_key, delay_key, age_key: the message sent in each step, that which the
            receiver held after it, the delay of the first [steps], -1 if it never arrives, and the age of
            the second [steps], all under ``"next"``, as ``ObservationDelay`` writes them.
        step_count_key: earlier steps of the episode, [T, B, 1] (``StepCounter``); 0 where it
            begins.
        hindsight_key: if given, the entry ``("next", hindsight_key)`` is added: the newest message
            sent by that step that has arrived by now; and its age ``hindsight_age`` beside
            ``delay_key``. Give it with ``order="arrival"`` if a sender may be silent for more than
            ``longest`` steps.
        options: of ``LazyTensorStorage``.
    """

    def __init__(
        self,
        max_size: int,
        recompute: Recompute | None,
        longest: int,
        *,
        corrections: Sequence[Correction] = (),
        message_key: NestedKey = keys.MESSAGE,
        received_key: NestedKey = keys.RECEIVED,
        delay_key: NestedKey = keys.DELAY,
        age_key: NestedKey = keys.AGE,
        step_count_key: NestedKey = keys.STEP_COUNT,
        hindsight_key: NestedKey | None = None,
        **options: Any,
    ) -> None:
        checks.whole("longest", longest, 0, unit="steps")
        super().__init__(max_size, **options)
        self.recompute = recompute
        self.longest = longest
        self.corrections = list(corrections)
        self._late_rewards = next((found for found in corrections if found.paid), None)
        if recompute is None:
            if self._late_rewards is None or hindsight_key is not None:
                should = (
                    "needs corrections that credit late rewards, and goes without hindsight_key"
                )
                raise InputError(f"recompute: None {should}")
            delay_key = cast(NestedKey, self._late_rewards.delay_key)
        delay_key = unravel_key(delay_key)
        self._sent, self._held = (next_key(unravel_key(key)) for key in (message_key, received_key))
        self._delay = next_key(delay_key)
        self._age = next_key(unravel_key(age_key))
        self._count = unravel_key(step_count_key)
        self._hindsight = None if hindsight_key is None else next_key(unravel_key(hindsight_key))
        # The storage adds these, but not under "next".
        self._backupdated = cast(NestedKey, sibling_key(delay_key, "backupdated"))
        self._hindsight_age = cast(NestedKey, sibling_key(delay_key, "hindsight_age"))
        self._n_worlds: int | None = None

    @property
    def lookback(self) -> int:
        """Number of earlier steps that the corrections of a step read."""
        return sum(correction.lookback for correction in self.corrections)

    def set(  # type: ignore[override]
        self, cursor: Any, data: TensorDictBase, *, set_cursor: bool = True
    ) -> None:
        """Write steps [T, B] at the indices ``cursor`` of the first dimension, and back-update."""
        checks.require(
            data.dim() == 2, "steps", f"a batch of shape {list(data.shape)}", "is not [T, B]"
        )
        checks.require(
            "steps_to_next_obs" not in data,
            "transform",
            "MultiStepTransform",
            "joins steps before they are corrected: leave it out, and join the steps that are read",
        )
        self._require_entries(data)
        super().set(cursor, self._with_added_entries(data), set_cursor=set_cursor)
        self.backupdate(len(data) + self.longest)

    def _require_entries(self, data: TensorDictBase) -> None:
        """Require that steps [T, B] have the entries that the storage reads, and fit into it."""
        late = self._late_rewards
        present = data.keys(True)
        delays = {"reward": next_key(late.delay_key)} if late and late.delay_key else {}
        needed = [("step_count_key", self._count), ("done", ENDS[0])]
        if self.recompute is not None:
            delays["message"] = self._delay
            needed += [
                ("message_key", self._sent),
                ("received_key", self._held),
                ("age_key", self._age),
            ]
        should = "is not in the steps: docs/backupdating.md says which transform writes it"
        for name, key in [*needed, *(("delay_key", delay) for delay in delays.values())]:
            checks.require(key in present, name, key, should)
        if self._n_worlds is None and min(data.shape) > 1:
            along = [
                (data[self._count].squeeze(-1).diff(dim=dim) == 1).double().mean() for dim in (0, 1)
            ]
            checks.require(
                bool(along[0] >= along[1]),
                "step_count",
                self._count,
                "grows from world to world instead of step to step: give ReplayBuffer.extend [B, T]",
            )
        n_worlds = self._n_worlds = data.shape[1] if self._n_worlds is None else self._n_worlds
        checks.require(
            data.shape[1] == n_worlds,
            "steps",
            f"a batch of shape {list(data.shape)}",
            f"is not one of {n_worlds} worlds: give ReplayBuffer.extend [B, T], as rollouts return "
            "it",
        )
        needs = len(data) + 2 * self.longest + self.lookback
        checks.require(
            self.max_size >= needs * n_worlds,
            "max_size",
            self.max_size,
            f"is too little for batches of {len(data)} steps and delays of up to {self.longest} "
            f"steps: {needs} steps of {n_worlds} worlds need {needs * n_worlds}",
        )
        for name, key in delays.items():
            takes = f"steps, but a {name} takes {int(data[key].max())} steps"
            checks.require(bool(data[key].max() <= self.longest), "longest", self.longest, takes)

    def _with_added_entries(self, data: TensorDictBase) -> TensorDictBase:
        """Copy of steps [T, B], with the entries that the storage adds, before any
        back-updating."""
        done = data[ENDS[0]]
        delay = data[self._delay]
        data = data.copy().update(
            {keys.VALID: torch.ones_like(done), keys.RESET_AFTER: done.clone()}
        )
        data[self._backupdated] = torch.zeros_like(delay, dtype=torch.bool)
        if self._hindsight is not None:
            data[self._hindsight] = data[self._held].clone()
            data[self._hindsight_age] = data[self._age].long()
        return data

    def backupdate(self, n_steps: int) -> None:
        """Correct the latest ``n_steps`` steps with all that has arrived by the last step."""
        # The entries of steps before these are right already; but one of their messages may be the
        # newest of a step to correct, and corrections read some.
        index = self.latest(n_steps + self.longest + self.lookback)
        n_steps = min(n_steps, len(index))
        read = n_steps + min(self.lookback + 1, len(index) - n_steps)
        messages, added = self._messages_by_now(self.rows(index), read)
        recomputed = self._recomputed(index[-read:], messages, read - n_steps)
        entries = {**recomputed, **added}
        self.overwrite(index[-n_steps:], {key: value[-n_steps:] for key, value in entries.items()})

    def _messages_by_now(self, steps: TensorDictBase, last: int) -> tuple[Tensor | None, Entries]:
        """The newest arrived message of each of the ``last`` of steps [T, B], and
        ``hindsight_key``."""
        if self.recompute is None:
            return None, {}
        held = steps[self._held]
        age = steps[self._age].long()
        delay = steps[self._delay]
        if self._hindsight is not None:
            # At the first step, the storage may know a newer message than the receiver held; its
            # sender may have sent it before that step, so that it is in no row of these steps.
            held = torch.cat([steps[self._hindsight][:1], held[1:]])
            age = torch.cat([steps[self._hindsight_age][:1], age[1:]])
        latest, age = latest_arrived(steps[self._sent], delay.squeeze(-1), held, age.squeeze(-1))
        latest = latest[-last:]
        age = age[-last:].unsqueeze(-1)
        hindsight = {self._hindsight: latest, self._hindsight_age: age}
        return latest, cast(Entries, hindsight if self._hindsight else {})

    def _recomputed(self, index: Tensor, messages: Tensor | None, n_right: int) -> Entries:
        """The corrected entries of the steps at ``index`` [T]; the first ``n_right`` are right
        already."""
        steps = self.rows(index)
        begins = steps[self._count].squeeze(-1) == 0
        entries = self.recompute(steps, messages) if self.recompute and messages is not None else {}
        after = self._correct(entries, steps)
        done, terminated, truncated = ENDS
        reset = steps[keys.RESET_AFTER]
        if done in after:
            after[truncated] = after[truncated] | (reset & ~after[terminated])
            after[done] = after[done] | reset
        already_ended = ~steps[keys.VALID][0].squeeze(-1) & ~begins[0]
        ended = steps[done]
        if done in after:
            ended = torch.cat([ended[:n_right], after[done][n_right:]])
        over = ended_before(ended.squeeze(-1), begins, already_ended)
        if self.recompute is not None:
            changed = _rewards_changed(after, steps, steps[self._backupdated])
        else:
            late = cast(Correction, self._late_rewards)
            paid = cast(Callable[..., Tensor], late.paid)(steps, steps[self._count].squeeze(-1))
            changed = paid & (steps[self._delay] > 0)
        marks = {self._backupdated: changed, keys.VALID: ~over.unsqueeze(-1)}
        return {**after, **self._before(index, after, begins, n_right), **marks}

    def _correct(self, entries: Entries, steps: TensorDictBase) -> Entries:
        """Apply the corrections to what ``recompute`` returned for steps [T, B]."""
        entries = {unravel_key(key): value for key, value in entries.items()}
        some = [key in entries for key in ENDS]
        checks.require(
            all(some) or not any(some),
            "recompute",
            ENDS,
            "are returned in part: return all or none",
        )
        count = steps[self._count].squeeze(-1)
        for correction in self.corrections:
            entries = correction.correct(entries, steps, count)
        for key, value in entries.items():
            stored = self.steps.get(key, None)
            should = "is not an entry after the steps of the same shape and dtype"
            written = (*value.shape, value.dtype)
            same = stored is not None and written == (*steps.shape, *stored.shape[2:], stored.dtype)
            checks.require(same and key[0] == "next", "recompute", key, should)
        return entries

    def _before(self, index: Tensor, after: Entries, begins: Tensor, n_right: int) -> Entries:
        """Entries before the steps that follow the right ones: those after the step before each."""
        keep = begins[n_right:].clone()
        keep[0] |= n_right == 0  # the step before the first one is not among these steps
        step, world = keep.nonzero(as_tuple=True)
        before = {}
        for next_, value in after.items():
            key = unravel_key(next_[1:])
            stored = None if next_ in ENDS else self.steps.get(key, None)
            if stored is not None:
                previous = value[n_right - 1 : -1] if n_right else value.roll(1, 0)
                before[key] = previous.clone()
                before[key][step, world] = stored[index[n_right:][step], world]
        return before


def _rewards_changed(after: Entries, steps: TensorDictBase, changed: Tensor) -> Tensor:
    """``changed`` [T, B, *, 1], now true also where the reward of a step is no longer the stored
    one."""
    for key in after:
        if keys.last_part(key) == keys.last_part(keys.REWARD):
            now = after[key] != steps[key]
            # All senders of a world may have changed a reward that is not of a sender.
            of_sender = (
                now if now.shape == changed.shape else expand_mask(now.flatten(2).any(-1), changed)
            )
            changed = changed | of_sender
    return changed
