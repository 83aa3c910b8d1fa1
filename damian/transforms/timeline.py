"""A transform that orders late observations by when they were true."""

from collections.abc import Callable, Collection

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from damian.common import checks
from damian.common.tensors import expand_mask
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
    table = facts.new_zeros(*slot.shape[:-1], slots + 1, facts.shape[-1])
    table = table.scatter(-2, slot.unsqueeze(-1).expand_as(facts), facts)
    told = torch.zeros(table.shape[:-1], dtype=torch.bool, device=slot.device).scatter(
        -1, slot, True
    )
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
    ) -> None:
        checks.whole("slots", slots, 1)
        should = "goes with messages of the observer alone: leave out group and ages"
        alone = not group and ages is None
        checks.require(position_key is None or alone, "position_key", position_key, should)
        super().__init__(message_key)
        self.slots = slots
        self.encode = encode
        self.ages = ages
        self.group = group
        self.own = own
        written, self.delay_key, self.sent_key, self.position_key = (
            sibling_key(self.row_key, key) for key in (out_key, delay_key, sent_key, position_key)
        )
        self.out_keys = [written]
        self.step_keys = existing([self.row_key, self.delay_key, self.sent_key, self.position_key])

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        first = self._by_row(self._sent(tensordict.get))
        if self.ages is not None:
            first["kept"] = first["kept"][:, 0]  # one fact for each slot
            del first["ages"]
        blank = {name: torch.zeros_like(value).unsqueeze(1) for name, value in first.items()}
        blank["due"] += _NEVER
        return {name: value.repeat_interleave(self.slots, 1) for name, value in blank.items()}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        empty = {
            name: torch.full_like(old, _NEVER * (name == "due")) for name, old in memory.items()
        }
        first = self._sent(entries.__getitem__)
        begun = self._added(empty, first | {"sent": torch.ones_like(first["sent"])})
        memory = {
            name: torch.where(expand_mask(mask, new), new, memory[name])
            for name, new in begun.items()
        }
        return memory, self._written(memory)

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        memory = self._added(memory, self._sent(entries.__getitem__))
        return memory, self._written(memory)

    def _sent(self, entry: Callable[[NestedKey], Tensor]) -> dict[str, Tensor]:
        """The messages of a step, or of many, by the names of the memory; ``entry`` returns an
        entry.

        ``kept`` [..., D], or [..., S, D] with their ``ages`` [..., S]; the steps until they are
        ``due`` at each of R receivers [..., R]; whether one was ``sent`` [...]; the ``position`` of
        the observer [..., P].
        """
        message = entry(self.row_key)
        kept = self.encoded(message)
        sent = torch.ones_like(message[..., 0], dtype=torch.bool)
        if self.sent_key is not None:
            sent = entry(self.sent_key).view(sent.shape)
        due = torch.zeros_like(sent, dtype=torch.long).unsqueeze(-1)
        if self.delay_key is not None:
            delay = entry(self.delay_key)
            delay = (
                delay.transpose(-1, -2) if delay.shape[-1] > 1 else delay
            )  # by sender and receiver
            due = torch.where(delay >= 0, delay, _NEVER)
        found = {"kept": kept, "due": due, "sent": sent}
        if self.ages is not None:
            found["ages"] = self.ages(message)
        return (
            found if self.position_key is None else found | {"position": entry(self.position_key)}
        )

    def _by_row(self, sent: dict[str, Tensor]) -> Memory:
        """The messages of ``_sent`` by rows, [M, ...] each; several rows in order may share a
        position."""
        n_rows = sent["sent"].numel()
        lead = sent["sent"].dim()
        rows = {
            n: each.reshape(n_rows, *each.shape[lead:])
            for n, each in sent.items()
            if n != "position"
        }
        if "position" in sent:
            position = sent["position"].reshape(-1, sent["position"].shape[-1])
            rows["position"] = position.repeat_interleave(n_rows // len(position), 0)
        return rows

    def _added(self, memory: Memory, sent: dict[str, Tensor]) -> Memory:
        """The memory with the messages of a step as the newest."""
        newest = self._by_row(sent)
        older = memory | {"due": memory["due"] - 1}
        newest["due"] = torch.where(newest["sent"].unsqueeze(-1), newest["due"], _NEVER)
        if self.ages is None:
            return {
                name: torch.cat([new.unsqueeze(1), older[name][:, :-1]], 1)
                for name, new in newest.items()
            }
        never = torch.full_like(older["due"][:, :1], _NEVER)
        blank = {
            "due": never,
            **{name: torch.zeros_like(memory[name][:, :1]) for name in ("kept", "sent")},
        }
        older = {name: torch.cat([blank[name], old[:, :-1]], 1) for name, old in older.items()}
        facts, told = told_slots(newest["kept"], newest["ages"], self.slots)
        told = told & newest["sent"].unsqueeze(-1)
        due = torch.minimum(older["due"], newest["due"].unsqueeze(1))
        return {
            "kept": torch.where(told.unsqueeze(-1), facts, older["kept"]),
            "due": torch.where(told.unsqueeze(-1), due, older["due"]),
            "sent": older["sent"] | told,
        }

    def _written(self, memory: Memory) -> Entries:
        """The timeline, from the memory."""
        found = self._timeline(memory, memory["due"] <= 0)
        return {self.out_keys[0]: found.view(*self.rows, *found.shape[1:])}

    def _timeline(self, slots: Memory, arrived: Tensor) -> Tensor:
        """The timelines of M rows, [M, K, D + 1] or, with those of N agents each, [M, N, K, D + 1].

        From ``slots`` in the shapes of the memory, whose messages have ``arrived`` [M, K, R] at
        receivers.
        """
        kept = slots["kept"]
        if "position" in slots:
            way = slots["position"][:, :1] - slots["position"]
            kept = kept - way.repeat(1, 1, kept.shape[-1] // way.shape[-1])
        n = self.rows[-1] if self.group else 1
        agent = torch.arange(n, device=kept.device)
        sender = (agent.unsqueeze(-1) + agent) % n  # [N receivers, N senders], its own first
        receiver = agent.unsqueeze(-1) if arrived.shape[-1] > 1 else torch.zeros_like(sender)

        def for_receivers(rows: Tensor) -> Tensor:
            return rows.unflatten(0, (-1, n))[:, sender]  # [worlds, N, N, K, ...]

        known = arrived.unflatten(0, (-1, n)).movedim(-1, 1)[
            :, receiver, sender
        ]  # [worlds, N, N, K]
        if self.own:
            known = known | ((agent == 0).unsqueeze(-1) & for_receivers(slots["sent"]))
        known = known.unsqueeze(-1)
        found = torch.cat([for_receivers(kept) * known, known.to(kept.dtype)], -1).flatten(0, 1)
        return found if self.group else found.squeeze(1)

    def hindsight(self, keys: Collection[NestedKey]) -> Correction | None:
        """Writes the timeline again if it is among ``keys``, with all that has arrived by the
        latest step.

        With ``ages``, what computes it again does so from the one before (``known_in_hindsight``).
        """
        wanted = self.out_keys[0] in keys and self.ages is None
        return Correction(self._corrected, self.slots) if wanted else None

    def _corrected(self, entries: Entries, steps: TensorDictBase, count: Tensor) -> Entries:
        after, first = (
            self._sent(lambda key, at=at: steps[at(key)]) for at in (next_key, lambda key: key)
        )
        first["sent"] = torch.ones_like(first["sent"])
        step = torch.arange(len(steps), device=count.device)
        slots = []
        arrived = []
        for k in range(self.slots):  # a slot of all steps and worlds at once
            sent_at = step - k  # before 0 lies what is not among the steps
            is_reset = (k == count + 1) & (sent_at >= -1).unsqueeze(-1)
            exists = is_reset | ((k <= count) & (sent_at >= 0).unsqueeze(-1))
            of_step = sent_at.clamp(min=0)
            of_reset = (sent_at + 1).clamp(0, len(steps) - 1)
            slot = {
                name: torch.where(expand_mask(is_reset, new), first[name][of_reset], new[of_step])
                for name, new in after.items()
            }
            slot["sent"] = slot["sent"] & expand_mask(exists, slot["sent"])
            due = slot["due"] <= expand_mask(len(steps) - 1 - sent_at, slot["due"])
            slots.append(self._by_row(slot))
            arrived.append((due & slot["sent"].unsqueeze(-1)).reshape(-1, due.shape[-1]))
        stacked = {name: torch.stack([slot[name] for slot in slots], 1) for name in after}
        found = self._timeline(stacked, torch.stack(arrived, 1))
        return entries | {
            next_key(self.out_keys[0]): found.view(*after["sent"].shape, *found.shape[1:])
        }

    def noted_late(self, memory: Memory, message: Tensor, agent: int, lag: int) -> Memory:
        """The memory with an agent's message [M] that arrives in the next step, ``lag`` >= 1 steps
        late."""
        facts = self.encoded(message).view(1, -1, memory["kept"].shape[-1])
        ages = (
            torch.zeros(1, 1, dtype=torch.long)
            if self.ages is None
            else self.ages(message).view(1, -1)
        )
        # Slots are of the step before the next one.
        kept, told = told_slots(facts, torch.where(ages < 0, -1, ages + lag - 1), self.slots)
        memory = {name: value.clone() for name, value in memory.items()}
        memory["kept"][agent] = torch.where(told[0].unsqueeze(-1), kept[0], memory["kept"][agent])
        memory["due"][agent] = torch.where(
            told[0].unsqueeze(-1), memory["due"][agent].clamp(max=1), memory["due"][agent]
        )
        memory["sent"][agent] |= told[0]
        return memory

    def encoded(self, message: Tensor) -> Tensor:
        """The numbers to keep of messages, [..., D]."""
        return message if self.encode is None else self.encode(message)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        spec = observation_spec[self.row_key]
        rows = spec_rows(observation_spec, self.row_key)
        encoded = self.encoded(spec.zero())
        n_numbers = encoded.shape[-1]
        shape = (*rows, *rows[-1:] * self.group, self.slots, n_numbers + 1)
        dtype = torch.promote_types(encoded.dtype, torch.float32)
        add_spec(observation_spec, self.out_keys[0], shape, dtype)
        return observation_spec
