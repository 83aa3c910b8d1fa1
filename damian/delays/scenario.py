"""The delay laws of a scenario and of its links, as the settings say."""

from damian import keys
from damian.common import checks
from damian.delays.config import DelayConfig, LinkConfig, is_matrix
from damian.delays.laws import LOSES, Held, Law, law_of, sampler_of
from damian.delays.samplers import Sampler

CONTEXT_KEYS = {"position": keys.POSITION}
"""TensorDict keys of the entries that a delay law of a scenario may read, by the name in ``reads``."""
DELAYED = ("obs", "act", "rew")
"""What a scenario delays: messages, actions, rewards."""


def delay_law(delay: DelayConfig, name: str) -> Law:
    """The law of ``act``, of ``rew``, or of ``obs`` with ``hold`` applied."""
    law = law_of(getattr(delay, name), f"delay.{name}")
    return Held(law) if name == "obs" and delay.hold == "max" else law


def delay_sampler(delay: DelayConfig, name: str, dt: float) -> Sampler:
    """The sampler of this law for steps of ``dt`` seconds, without the losses of ``loss``."""
    return sampler_of(delay_law(delay, name), dt, key=f"delay.{name}")


def delay_reads(delay: DelayConfig, dt: float) -> set[str]:
    """Names of the entries that the laws read in the contexts of messages."""
    return {read for name in DELAYED for read in delay_sampler(delay, name, dt).reads}


def check_laws(delay: DelayConfig, dt: float) -> None:
    """Check that every law is valid for steps of ``dt`` seconds."""
    for name in DELAYED:
        for read in delay_sampler(delay, name, dt).reads:
            problem = f"reads {read}, but a law can read only {', '.join(CONTEXT_KEYS)}"
            checks.require(read in CONTEXT_KEYS, f"delay.{name}", getattr(delay, name), problem)
    checks.require(not delay_sampler(delay, "rew", dt).loses, "delay.rew", delay.rew, LOSES)


def link_reads(links: LinkConfig, dt: float) -> set[str]:
    """Names of the entries that the links read: what their laws do, and positions for a range."""
    written = {"links.delay": links.delay}
    if is_matrix(links.delay):
        rows = [enumerate(row) for row in links.delay]
        written = {f"links.delay[{i}][{j}]": law for i, row in enumerate(rows) for j, law in row}
    read = {name for key, law in written.items() for name in sampler_of(law, dt, key=key).reads}
    return read | ({"position"} if links.range is not None else set())
