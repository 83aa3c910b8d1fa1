"""Settings of the delays of a scenario, of its cumulative rewards and of the action history."""

from dataclasses import dataclass
from typing import Any

from damian import keys
from damian.common import checks
from damian.common.text_files import show
from damian.delays.delay_line import ORDERS
from damian.delays.laws import LONGEST, LOSES, Held, Law, law_of, sampler_of
from damian.delays.samplers import Sampler

CONTEXT_KEYS = {"position": keys.POSITION}
"""TensorDict keys of the entries that a delay law of a scenario may read, by the name in ``reads``."""


@dataclass
class DelayConfig:
    """Delays and how they are handled. A law is a number of steps, a time, or a mapping (``law_of``)."""

    obs: Any = 0
    """Law of the delay of each UAV's messages to the server node (paper, section 3.4)."""
    act: Any = 0
    """Law of the delay of each action (section 3.3); a UAV holds its position until the first one arrives."""
    rew: Any = 0
    """Law of the delay of the rewards, which must not lose any (section 3.5)."""
    loss: float = 0.0
    """Probability that a message to the server node is lost."""
    hold: str = "none"
    """``max``: the server holds every message back until the longest delay of ``obs`` has passed, so that the
    delay is constant."""
    order: str = "generation"
    """Which received message the server holds: the one generated last (``generation``; the age of information
    then grows by at most one step per step) or the one that arrived last (``arrival``)."""
    history: int = 0
    """Number of its own latest actions that a UAV observes (section 3.3)."""
    reward_window: int = 1
    """Number of steps over which rewards are summed (eq. 4)."""
    reward_discount: float = 0.9
    """Discount factor gamma of that sum (eq. 4)."""

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
        """Law of the messages to the server node, with ``hold`` applied."""
        law = law_of(self.obs, "delay.obs")
        return Held(law) if self.hold == "max" else law

    def reads(self, dt: float) -> set[str]:
        """Names of the entries that the laws read in the contexts of messages."""
        return {name for sampler in self._samplers(dt).values() for name in sampler.reads}

    def sees_context(self, dt: float) -> bool:
        """Whether a law computes delays from the contexts of messages."""
        return any(sampler.sees_context for sampler in self._samplers(dt).values())

    def check(self, dt: float) -> None:
        """Check that every law is valid for steps of ``dt`` seconds.

        Raises:
            InputError: a law is invalid or reads what there is not, or the reward delay loses rewards.
        """
        samplers = self._samplers(dt)
        for name, sampler in samplers.items():
            for read in sampler.reads:
                should = f"reads {read}, but a law can read only {', '.join(CONTEXT_KEYS)}"
                checks.require(read in CONTEXT_KEYS, f"delay.{name}", show(getattr(self, name)), should)
        checks.require(not samplers["rew"].loses, "delay.rew", show(self.rew), LOSES)

    def _samplers(self, dt: float) -> dict[str, Sampler]:
        """The samplers of the laws, by the name of the setting."""
        names = ("obs", "act", "rew")
        laws = {name: law_of(getattr(self, name), f"delay.{name}") for name in names}
        return {name: sampler_of(law, dt, key=f"delay.{name}") for name, law in laws.items()}
