"""What the transforms of a server node remember where reports arrive late, or not at all for many steps."""

import torch
from torch import Tensor

from damian.envs.nodes import Belief
from damian.server.belief import report_rows
from damian.transforms.base import Memory, StatefulTransform
from damian.transforms.hold import SampleAndHold
from damian.transforms.timeline import ObservationTimeline


def note_late(transform: StatefulTransform, memory: Memory, message: Tensor, agent: int, lag: int) -> Memory:
    """Note an agent's packed message [M] that arrives in the next step, ``lag`` >= 1 steps late.

    Of a single world; what a belief remembers is changed in place.
    """
    if isinstance(transform, ObservationTimeline) and lag <= transform.slots:
        row = {"kept": transform.encoded(message.view(1, 1, -1)).view(-1), "due": 1, "sent": True}
        memory = memory | {name: memory[name].clone() for name in row}
        for name, value in row.items():
            memory[name][agent, lag - 1] = value
    if isinstance(transform, Belief) and lag <= transform.longest:
        messages = transform.server.messages(message.view(1, 1, -1))
        slot = (memory["slot"] + 1 - lag) % len(memory["report"])
        every = torch.ones_like(messages.spotted)
        memory["report"][slot, agent] = report_rows(transform.grid, messages, every).view(-1)
        memory["delay"][slot, agent] = lag
    return memory


def after_idle_steps(transform: StatefulTransform, memory: Memory, n_steps: int) -> Memory:
    """The memory after steps in which no message arrived and no agent chose an action; beliefs stay."""
    counted = {name: memory[name] + n_steps for name in ("elapsed", "since", "age") if name in memory}
    if isinstance(transform, SampleAndHold):
        counted["elapsed"] = counted["elapsed"] % transform.period
    return memory | counted
