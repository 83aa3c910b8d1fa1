"""Commands that survive lateness: each names the place to which it leads, wherever it arrives."""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn import functional as F
from torchrl.data import Composite

from damian import keys
from damian.common.tensors import expand_mask, gather_rows, where_rows
from damian.transforms.action import ActionDelay
from damian.transforms.base import Change, Memory
from damian.transforms.entries import Entries, add_spec
from damian.world.landing import Candidates


class CommandDelay(ActionDelay):
    """An ``ActionDelay`` whose actions begin where the agent saw itself when it chose them.

    With each action travels the landing point from which it was chosen (``frame``), so that it
    leads to the same place wherever its UAV is by then; the environment gets that of the action
    which it executes, and its number, as ``command``. What an agent has sent is known to itself at
    once: ``commands`` tells where its latest ones lead, their numbers, and the steps by which they
    have been executed, or never will be. If flights take time, an agent is not ready while a
    command is under way.

    Args:
        delay, options: as in ``ActionDelay``.
        candidates: landing points to which actions lead.
        n_commands: number of the latest commands that ``commands`` tells, K.
        waits: whether an agent is not ready while a command of its own is under way.
    """

    def __init__(
        self, delay: Any, candidates: Candidates, n_commands: int, *, waits: bool, **options: Any
    ) -> None:
        super().__init__(delay, keys.ACTION, **options)
        self.candidates = candidates
        self.n_commands = n_commands
        self.waits = waits
        self.out_keys = [keys.COMMANDS]
        self.step_keys = [keys.READY]
        self.action_keys = [*self.action_keys, keys.FRAME]

    @property
    def required_keys(self) -> list:
        return [*super().required_keys, keys.FRAME, keys.READY]

    def begins(self) -> list[Tensor]:
        (action,) = super().begins()
        return [action, torch.zeros(len(action), 2, dtype=torch.long, device=action.device)]

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        memory = super().init_memory(tensordict)
        clock = memory["clock"]
        return memory | {"commands": clock.new_zeros(len(clock), self.n_commands, 3)}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        memory, _ = super().on_reset(memory, entries, mask)
        commands = memory["commands"]
        memory["commands"] = commands.masked_fill(expand_mask(mask, commands), 0)
        return memory, {keys.COMMANDS: self.from_rows(memory["commands"]).clone()}

    def beside(self, memory: Memory, entries: Entries) -> list[Tensor]:
        number = memory["clock"] + 1 - memory["reset_at"]
        return [torch.stack([self.to_rows(entries[keys.FRAME]), number], -1)]

    def on_action(self, memory: Memory, entries: Entries) -> Change:
        frame = entries[keys.FRAME]
        place = self.to_rows(destination(self.candidates, frame, entries[keys.ACTION]))
        memory, executed = super().on_action(memory, entries)
        number = memory["clock"] - memory["reset_at"]
        newest = torch.stack([place, number, number + self.sampler.longest], -1).unsqueeze(1)
        commands = torch.cat([newest, memory["commands"][:, :-1]], 1)
        sent = self.sending_rows(entries)
        if sent is not None:
            commands = where_rows(sent, commands, memory["commands"])
        memory["commands"] = commands
        held = F.pad(memory["held_1"], (0, 1)).unsqueeze(1)
        executed[keys.COMMAND] = self.from_rows(torch.cat([held, commands], 1))
        return memory, executed

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        written: Entries = {keys.COMMANDS: self.from_rows(memory["commands"]).clone()}
        if self.waits:
            _, number, latest = memory["commands"][:, 0].unbind(-1)
            executed = memory["generated_at"] - memory["reset_at"] >= number
            elapsed = memory["clock"] - memory["reset_at"]
            arrived = executed | (elapsed >= latest)
            written[keys.READY] = entries[keys.READY] & arrived.view(self.rows)
        return memory, written

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        shape = (*observation_spec[keys.FRAME].shape, self.n_commands, 3)
        add_spec(observation_spec, keys.COMMANDS, shape, torch.long)
        return observation_spec


def destination(candidates: Candidates, frame: Tensor, action: Tensor) -> Tensor:
    """The landing points to which actions lead from others if all are free, flat ids [B, N]."""
    n_points = candidates.airspace.max_points
    region = frame[:, 0] // n_points
    ranking, row = candidates.rank(frame, region, action)
    point = gather_rows(ranking.point, row)[..., 0].long()
    return point + region.unsqueeze(-1) * n_points
