"""Components with one mistake each, which ``test_mistakes.py`` uses as ``wrong:name``."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from damian import ContextSampler, Law, MessageContext


@dataclass(frozen=True)
class Rush(Law):
    """A law that makes the mistake of this name."""

    mistake: str
    start: Any = 3.0

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Any:
        if self.mistake == "raise":
            raise RuntimeError("no\n  signal")
        if self.mistake == "none":
            return None
        return ContextSampler(getattr(self, self.mistake), 5, loss)

    def typo(self, context: MessageContext) -> Tensor:
        return context.tme  # type: ignore[attr-defined]

    def branch(self, context: MessageContext) -> Tensor:
        return context.time if context.time > self.start else context.time + 1

    def compares(self, context: MessageContext) -> Tensor:
        return (context.time > self.start).long()

    def undefined(self, context: MessageContext) -> Tensor:
        return torch.where(context.sender == 1, torch.inf, context.time)

    def undeclared(self, context: MessageContext) -> Tensor:
        return context.entries["position"][:, 0]
