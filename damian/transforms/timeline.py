"""A transform that orders late observations by when they were true."""

from collections.abc import Callable, Collection

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from damian.common import checks
from damian.common.tensors import expand_mask, where_rows
from damian.keys import next_key
from damian.transforms.base import Change, Correction, Memory, StatefulTransform
from damian.transforms.entries import Entries, add_spec, existing, sibling_key, spec_rows

_NEVER = 2**31
"""Steps until the arrival of a message that never arrives."""


def told_slots(facts: Tensor, ages: Tensor, slots: int) -> tuple[Tensor, Tensor]:
    """Facts [*, S, D] by their ages [*, S] in steps: slot k holds that of age k, [*, K, D]; zeros
    if none has.

    Also which slots a fact tells of, [*, K] bool. Ages below 0, or of ``slots`` or more, are left
    out.
    """
    slot = torch.where((ages < 0) | (ages >= slots), slots, ages)  # the last one is left out
    index = slot.unsqueeze(-1).expand_as(facts)
    table = facts.new_zeros(*slot.shape[:-1], slots + 1, facts.shape[-1])
    table = table.scatter(-2, index, facts)
    told = table.new_zeros(table.shape[:-1], dtype=torch.bool)
    told = told.scatter(-1, slot, True)
    return table[..., :slots, :], told[..., :slots]


class ObservationTimeline(StatefulTransform):
    """Writes what is known of the latest steps, ordered by when it was true.

    It comes after ``ObservationDelay(..., delay_key=...)`` or ``Channel(..., delay_key=...)``,
    which draw the delays. Slot k holds what was true k steps ago, followed by 1, once a message
    that tells it has arrived; until then, and before the reset, it holds zeros. A message tells
    what was true when it was generated, and with ``ages`` also what was true before; two messages
    about one step agree. What it holds depends on nothing else, whenever and in whichever order
    messages arrive, so that one policy can serve every delay. ``received`` and ``age`` alone do not
    show overtaken messages, nor the second one to arrive in a step.

    A worked timeline, with 4 slots: the message of t = 1 arrives at t = 4 and is overtaken by that
    of t = 2, which arrives at t = 3, and the one of t = 3 is lost. At t = 3 the slots, of t = 3, 2,
    1 and 0, hold (-, 2, -, 0), as the message of the reset, t = 0, is known at once. At t = 4 they
    hold (-, -, 2, 1).

    Args:
        slots: number of latest steps, K.
        message_key: key of the message of a step, [..., D].
        out_key: key of the timeline, [..., K, D + 1] float32, or float64 as the messages; with
            ``group`` [..., N, K, D + 1]. A bare name, here and below, means an entry beside the
            message.
        delay_key: key of the delay of the message sent in this step [steps], [..., 1], or with
            ``group`` [..., N] by receiver and sender; -1 if it never arrives. None if messages are
            not delayed.
        sent_key: key of a flag, [...] bool: which rows send a message in this step; if not given,
            all do.
        position_key: key of the observer's own position, [..., P], which it knows at once. Messages
            are then places relative to the observer (D is a multiple of P), and each slot moves
            them into its present frame, by its displacement since. Several rows of messages in
            order may belong to one observer.
        encode: function from messages [..., M] to the D numbers to keep; if not given, these are
            the message. With ``ages``, to the S facts that a message tells, [..., S, D].
        ages: function from messages [..., M] to the ages of these facts when the message is
            generated [steps], [..., S] long; -1 for none.
        group: every agent gets the messages of all agents: its own first, then those of the agents
            after it.
        own: whether an agent knows its own messages as soon as they are sent.
        own_key: key of a second timeline of the same shape, which holds what was sent, arrived or
            not: what each sender knows itself. Not with ``group`` or ``position_key``.

    Examples:
        >>> delay = ObservationDelay(Uniform(3, 7), "observation", "received", delay_key="delay")
        >>> timeline = ObservationTimeline(8, "observation", delay_key="delay")
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(delay, timeline))
        >>> env.rollout(100)["timeline"]  # [100 steps, 8 slots, 3 + 1 numbers]
    """

    def __init__(
        self,
        slots: int,
        message_key: NestedKey = "observation",
        out_key: NestedKey = "timeline",
        *,
        delay_key: NestedKey | None = None,
        sent_key: NestedKey | None = None,
        position_key: NestedKey | None = None,
        encode: Callable[[Tensor], Tensor] | None = None,
        ages: Callable[[Tensor], Tensor] | None = None,
        group: bool = False,
        own: bool = False,
        own_key: NestedKey | None = None,
    ) -> None:
        checks.whole("slots", slots, 1)
        should = "goes with messages of the observer alone: leave out group and ages"
        alone = not group and ages is None
        checks.require(position_key is None or alone, "position_key", position_key, should)
        shared = not group and position_key is None
        checks.require(
            own_key is None or shared,
            "own_key",
            own_key,
            "goes with messages in one frame: leave out group and position_key",
        )
        super().__init__(message_key)
        self.slots = slots
        self.encode = encode
        self.ages = ages
        self.group = group
        self.own = own
        written, of_sender, self.delay_key, self.sent_key, self.position_key = (
            sibling_key(self.row_key, key)
            for key in (out_key, own_key, delay_key, sent_key, position_key)
        )
        self.out_keys = existing([written, of_sender])
        self.step_keys = existing([self.row_key, self.delay_key, self.sent_key, self.position_key])

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        first = self._by_row(self._sent(tensordict.get))
        if self.ages is not None:
            first["kept"] = first["kept"][:, 0]  # one fact for each slot
            del first["ages"]
        blank = {}
        for name, value in first.items():
            shape = (len(value), self.slots, *value.shape[1:])
            blank[name] = value.new_zeros(shape)
        blank["due"] += _NEVER
        return blank

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        empty = {name: torch.zeros_like(old) for name, old in memory.items()}
        empty["due"] += _NEVER
        first = self._sent(entries.__getitem__)
        first["sent"] = torch.ones_like(first["sent"])
        begun = self._added(empty, first)
        memory = {name: where_rows(mask, new, memory[name]) for name, new in begun.items()}
        return memory, self._written(memory)

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        memory = self._added(memory, self._sent(entries.__getitem__))
        return memory, self._written(memory)

    def _sent(self, entry: Callable[[NestedKey], Tensor]) -> Memory:
        """The messages of a step, or of many, by the names of the memory; ``entry`` returns an
        entry.

        ``kept`` [..., D], or [..., S, D] with their ``ages`` [..., S]; the steps until they are
        ``due`` at each of R receivers [..., R]; whether one was ``sent`` [...]; the ``position`` of
        the observer [..., P].
        """
        message = entry(self.row_key)
        sent = torch.ones_like(message[..., 0], dtype=torch.bool)
        if self.sent_key is not None:
            sent = entry(self.sent_key).view(sent.shape)
        due = torch.zeros_like(sent, dtype=torch.long).unsqueeze(-1)
        if self.delay_key is not None:
            delay = entry(self.delay_key)
            if delay.shape[-1] > 1:
                delay = delay.transpose(-1, -2)  # by sender and receiver
            due = torch.where(delay >= 0, delay, _NEVER)
        found = {"kept": self.encoded(message), "due": due, "sent": sent}
        if self.ages is not None:
            found["ages"] = self.ages(message)
        if self.position_key is not None:
            found["position"] = entry(self.position_key)
        return found

    def _by_row(self, sent: Memory) -> Memory:
        """The messages of ``_sent`` by rows, [M, ...] each; several rows in order may share a
        position."""
        n_rows = sent["sent"].numel()
        lead = sent["sent"].dim()
        rows = {}
        for name, each in sent.items():
            if name == "position":
                position = each.reshape(-1, each.shape[-1])
                rows[name] = position.repeat_interleave(n_rows // len(position), 0)
            else:
                rows[name] = each.reshape(n_rows, *each.shape[lead:])
        return rows

    def _added(self, memory: Memory, sent: Memory) -> Memory:
        """The memory with the messages of a step as the newest."""
        newest = self._by_row(sent)
        older = memory | {"due": memory["due"] - 1}
        is_sent = newest["sent"].unsqueeze(-1)
        newest["due"] = torch.where(is_sent, newest["due"], _NEVER)
        if self.ages is None:
            return {
                name: torch.cat([new.unsqueeze(1), older[name][:, :-1]], 1)
                for name, new in newest.items()
            }
        blank = {name: torch.zeros_like(old[:, :1]) for name, old in older.items()}
        blank["due"] += _NEVER
        older = {name: torch.cat([blank[name], old[:, :-1]], 1) for name, old in older.items()}
        facts, told = told_slots(newest["kept"], newest["ages"], self.slots)
        told = told & is_sent
        due = older["due"].minimum(newest["due"].unsqueeze(1))
        return {
            "kept": where_rows(told, facts, older["kept"]),
            "due": where_rows(told, due, older["due"]),
            "sent": older["sent"] | told,
        }

    def _written(self, memory: Memory) -> Entries:
        """The timeline, from the memory."""
        found = [self._timeline(memory, memory["due"] <= 0)]
        if len(self.out_keys) > 1:
            sent = memory["sent"].unsqueeze(-1)
            found.append(torch.cat([memory["kept"] * sent, sent.to(memory["kept"].dtype)], -1))
        return {
            key: each.view(*self.rows, *each.shape[1:])
            for key, each in zip(self.out_keys, found, strict=True)
        }

    def _timeline(self, slots: Memory, arrived: Tensor) -> Tensor:
        """The timelines of M rows, [M, K, D + 1] or, with those of N agents each, [M, N, K, D + 1].

        From ``slots`` in the shapes of the memory, whose messages have ``arrived`` [M, K, R] at
        receivers.
        """
        kept = slots["kept"]
        if "position" in slots:
            way = slots["position"][:, :1] - slots["position"]
            n_places = kept.shape[-1] // way.shape[-1]
            kept = kept - way.repeat(1, 1, n_places)
        n = self.rows[-1] if self.group else 1
        agent = torch.arange(n, device=kept.device)
        receiver = agent.unsqueeze(-1)
        sender = (receiver + agent) % n  # [N receivers, N senders], its own first
        if arrived.shape[-1] == 1:
            receiver = torch.zeros_like(sender)

        def for_receivers(rows: Tensor) -> Tensor:
            return rows.unflatten(0, (-1, n))[:, sender]  # [worlds, N, N, K, ...]

        by_receiver = arrived.unflatten(0, (-1, n)).movedim(-1, 1)
        known = by_receiver[:, receiver, sender]  # [worlds, N, N, K]
        if self.own:
            itself = (agent == 0).unsqueeze(-1)
            known = known | (itself & for_receivers(slots["sent"]))
        known = known.unsqueeze(-1)
        told = for_receivers(kept) * known
        found = torch.cat([told, known.to(kept.dtype)], -1).flatten(0, 1)
        return found if self.group else found.squeeze(1)

    def hindsight(self, keys: Collection[NestedKey]) -> Correction | None:
        """Writes the timeline again if it is among ``keys``, with all that has arrived by the
        latest step.

        With ``ages``, what computes it again does so from the one before (``known_in_hindsight``).
        """
        wanted = self.out_keys[0] in keys and self.ages is None
        return Correction(self._corrected, self.slots) if wanted else None

    def _corrected(self, entries: Entries, steps: TensorDictBase, count: Tensor) -> Entries:
        first = self._sent(steps.__getitem__)
        after = self._sent(lambda key: steps[next_key(key)])
        first["sent"] = torch.ones_like(first["sent"])
        last = len(steps) - 1
        step = torch.arange(len(steps), device=count.device)
        slots = []
        arrived = []
        for k in range(self.slots):  # a slot of all steps and worlds at once
            sent_at = step - k  # before 0 lies what is not among the steps
            age_now = last - sent_at
            of_step = sent_at.clamp(min=0)
            of_reset = (sent_at + 1).clamp(0, last)
            is_reset = (k == count + 1) & (sent_at >= -1).unsqueeze(-1)
            is_step = (k <= count) & (sent_at >= 0).unsqueeze(-1)
            exists = is_reset | is_step
            slot = {
                name: where_rows(is_reset, first[name][of_reset], new[of_step])
                for name, new in after.items()
            }
            sent = slot["sent"] & expand_mask(exists, slot["sent"])
            slot["sent"] = sent
            is_due = slot["due"] <= expand_mask(age_now, slot["due"])
            has_arrived = is_due & sent.unsqueeze(-1)
            slots.append(self._by_row(slot))
            arrived.append(has_arrived.flatten(0, -2))
        stacked = {name: torch.stack([slot[name] for slot in slots], 1) for name in after}
        found = self._timeline(stacked, torch.stack(arrived, 1))
        found = found.view(*after["sent"].shape, *found.shape[1:])
        return entries | {next_key(self.out_keys[0]): found}

    def encoded(self, message: Tensor) -> Tensor:
        """The numbers to keep of messages, [..., D]."""
        return message if self.encode is None else self.encode(message)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        spec = observation_spec[self.row_key]
        rows = spec_rows(observation_spec, self.row_key)
        encoded = self.encoded(spec.zero())
        width = encoded.shape[-1] + 1
        senders = rows[-1:] if self.group else ()
        shape = (*rows, *senders, self.slots, width)
        dtype = torch.promote_types(encoded.dtype, torch.float32)
        for key in self.out_keys:
            add_spec(observation_spec, key, shape, dtype)
        return observation_spec
