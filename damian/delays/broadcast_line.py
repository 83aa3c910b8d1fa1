"""A delay line whose senders send the same message to several receivers, so that it is stored only once."""

import torch
from torch import Tensor

from damian.common.tensors import expand_mask
from damian.delays.delay_line import DelayLine, Memory, slot_rows
from damian.delays.samplers import MessageContext, Sampler


class BroadcastLine:
    """Delays the messages of S senders on L links, each of which leads from one sender to one receiver.

    A receiver holds the message of the link that was generated last. A ``DelayLine`` delays only the time of
    generation; the contents of the latest messages lie in a ring, once for each sender. The memory has that
    of the ``DelayLine``, and

    - ``sender``: sender of each link, [L], and ``link``: a link of each sender, [S];
    - ``contents_i``: contents of the latest K messages of each sender, [K, S, ...], where K is the longest
      delay plus 1, and ``held_i``: contents of the message that each link's receiver holds, [L, ...]; zeros
      before a message has arrived.

    Steps and resets are pure functions of the memory, except that ``write`` and ``step`` write the ring and
    the times of generation in place.

    Args:
        sampler: draws the delays.
    """

    def __init__(self, sampler: Sampler) -> None:
        self.line, self._n_slots = DelayLine(sampler, "generation"), sampler.longest + 1

    def init_memory(self, contents: list[Tensor], streams: Tensor, sender: Tensor) -> Memory:
        """Create the memory.

        Args:
            contents: examples of what is sent, [S, ...] each.
            streams: random stream of each link, [L].
            sender: sender of each link, [L]; every sender has a link.
        """
        memory = self.line.init_memory([], streams)
        links = torch.arange(len(sender), device=sender.device)
        link = links.new_zeros(len(contents[0])).scatter_reduce(0, sender, links, "amax")
        memory |= {"sender": sender, "link": link}
        for i, content in enumerate(contents):
            memory[f"contents_{i}"] = content.new_zeros(self._n_slots, *content.shape)
            memory[f"held_{i}"] = content.new_zeros(len(sender), *content.shape[1:])
        return memory

    def n_bytes(self, n_senders: int, n_links: int, size: int) -> int:
        """Size of the memory for so many senders, links and messages of ``size`` bytes, about [bytes]."""
        return self.line.n_bytes(n_links, 0) + n_links * (8 + size) + n_senders * (8 + self._n_slots * size)

    def reset(self, memory: Memory, mask: Tensor) -> Memory:
        """Where the mask [L] is true, discard the messages that are held or in transit."""
        memory, _ = self.line.reset(memory, [], mask)
        held = {f"held_{i}": memory[f"held_{i}"] for i in range(self._n_contents(memory))}
        return memory | {name: value.masked_fill(expand_mask(mask, value), 0) for name, value in held.items()}

    def write(self, memory: Memory, contents: list[Tensor]) -> None:
        """Write what the senders send in the next step, [S, ...] each; a step may send it or not."""
        rows = slot_rows((memory["clock"][memory["link"]] + 1) % self._n_slots)
        for i, content in enumerate(contents):
            memory[f"contents_{i}"].flatten(0, 1).index_copy_(0, rows, content)

    def step(self, memory: Memory, sent: Tensor, context: MessageContext | None = None) -> Memory:
        """Send the messages written last, and deliver those that arrive in this step.

        Args:
            memory: the memory before the step.
            sent: mask of the links that carry a message, [L] bool.
            context: circumstances of the messages; needed only if the sampler sees them.
        """
        memory, delivery = self.line.step(memory, [], sent, context)
        return self._hold(memory, delivery.fresh)

    def know(self, memory: Memory, mask: Tensor) -> Memory:
        """Where the mask [L] is true, deliver the messages of the latest step at once, sent or not."""
        generated_at = torch.where(mask, memory["clock"], memory["generated_at"])
        return self._hold(memory | {"generated_at": generated_at}, mask)

    def newest(self, memory: Memory) -> list[Tensor]:
        """What the senders wrote for the latest step, [S, ...] each."""
        rows = slot_rows(memory["clock"][memory["link"]] % self._n_slots)
        ring = [memory[f"contents_{i}"] for i in range(self._n_contents(memory))]
        return [contents.flatten(0, 1).index_select(0, rows) for contents in ring]

    def held(self, memory: Memory) -> list[Tensor]:
        """Contents of the held messages, [L, ...] each."""
        return [memory[f"held_{i}"] for i in range(self._n_contents(memory))]

    def _hold(self, memory: Memory, mask: Tensor) -> Memory:
        """Where the mask [L] is true, hold the messages that were generated at ``generated_at``."""
        slot, n_senders = memory["generated_at"] % self._n_slots, len(memory["link"])
        rows, updated = slot * n_senders + memory["sender"], {}
        for i, old in enumerate(self.held(memory)):
            new = memory[f"contents_{i}"].flatten(0, 1).index_select(0, rows)
            updated[f"held_{i}"] = torch.where(expand_mask(mask, old), new, old)
        return memory | updated

    def _n_contents(self, memory: Memory) -> int:
        return sum(name.startswith("held_") for name in memory)
