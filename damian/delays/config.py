"""Settings of everything that is delayed in a scenario, and of the action history."""

from dataclasses import dataclass
from typing import Any

from damian.common import checks
from damian.common.text_files import show
from damian.delays.delay_line import ORDERS
from damian.delays.laws import LONGEST, LOSES, Held, Law, law_of


@dataclass
class DelayConfig:
    """What arrives late, and what is done about it. A law is steps, a time, or a mapping (``law_of``)."""

    obs: Any = 0
    """Delay of each UAV's messages to the server node."""
    act: Any = 0
    """Delay between a UAV's choice and its execution; until the first arrives it holds."""
    rew: Any = 0
    """Delay of the rewards."""
    loss: float = 0.0
    """Probability that a message is lost."""
    hold: str = "none"
    """``max``: the server keeps every message back until the longest delay that ``obs`` allows has passed, so
    that the delay is constant."""
    order: str = "generation"
    """The server believes the message that was generated last (``generation``, the age of what it knows
    grows by at most a step each step) or that arrived last (``arrival``)."""
    history: int = 0
    """How many of its own latest actions a UAV sees."""
    reward_window: int = 1
    """Steps over which rewards are summed up (eq. 4)."""
    reward_discount: float = 0.9
    """Gamma of eq. 4."""

    def __post_init__(self) -> None:
        checks.in_range("delay.loss", self.loss, 0.0, 1.0)
        checks.one_of("delay.hold", self.hold, ("none", "max"))
        checks.one_of("delay.order", self.order, ORDERS)
        checks.whole("delay.history", self.history, 0, 1000, "actions")
        checks.whole("delay.reward_window", self.reward_window, 1, LONGEST, "steps")
        checks.above("delay.reward_discount", self.reward_discount, 0.0)
        checks.in_range("delay.reward_discount", self.reward_discount, 0.0, 1.0)

    @property
    def uplink(self) -> Law:
        """The law that the messages to the server really follow."""
        law = law_of(self.obs, "delay.obs")
        return Held(law) if self.hold == "max" else law

    def check(self, dt: float) -> None:
        """Make sure that the laws mean something at this length of a step [s].

        Raises:
            InputError: names the one that does not.
        """
        samplers = {
            name: law_of(getattr(self, name), f"delay.{name}").sampler(dt, key=f"delay.{name}")
            for name in ("obs", "act", "rew")
        }
        checks.require(not samplers["rew"].loses, "delay.rew", show(self.rew), LOSES)
