"""The delays of a scenario as one object, whose laws are resolved from the settings."""

from typing import Any

from damian import keys
from damian.common import checks
from damian.delays.config import DelayConfig, LinkConfig
from damian.delays.laws import LOSES, link_sampler, sampler_of
from damian.delays.samplers import HeldSampler, LossSampler, Sampler


class ScenarioDelays:
    """The samplers of all that can be late in a scenario, made by ``ScenarioConfig.make_delays``.

    With ``draws_loss``, the loss of messages to the server differs by world and episode
    (``randomise``). Raises ``InputError`` if a law is wrong, reads what no message carries, or
    loses rewards.
    """

    def __init__(
        self, delay: DelayConfig, links: LinkConfig, dt: float, draws_loss: bool = False
    ) -> None:
        law = sampler_of(delay.obs, dt, 0.0 if draws_loss else delay.loss, "delay.obs")
        obs = LossSampler(law) if draws_loss else law
        self.obs: Sampler = HeldSampler(obs) if delay.hold == "max" else obs
        """Of the messages to the server, with their losses, and as the server holds them back."""
        act = sampler_of(delay.act, dt, delay.act_loss, "delay.act")
        self.act: Sampler = HeldSampler(act) if delay.act_hold == "max" else act
        """Of the actions, with their losses, and as the UAVs hold them back."""
        self.rew = sampler_of(delay.rew, dt, key="delay.rew")
        """Of the rewards, none of which is lost."""
        self.links = link_sampler(links.delay, links.loss, dt, "links.delay")
        """Of what the UAVs receive from the server (updown), or from each other (matrix)."""
        checks.require(not self.rew.loses, "delay.rew", delay.rew, LOSES)
        laws = {
            "delay.obs": law,
            "delay.act": self.act,
            "delay.rew": self.rew,
            "links.delay": self.links,
        }
        for key, sampler in laws.items():
            told_receiver = key == "links.delay" and links.kind == "matrix"
            known = ["position", *["receiver_position"] * told_receiver]
            for name in sampler.reads:
                checks.require(
                    name in known,
                    key,
                    type(sampler).__name__,
                    f"reads {name}, but a law can read only {', '.join(known)}",
                )
        self.reads_positions = links.range is not None or any(
            sampler.reads for sampler in laws.values()
        )
        """Whether a law, or the range of the links, needs to know where the UAVs are."""
        context_keys = {"position": keys.POSITION} if self.reads_positions else {}
        context_keys |= {"loss": keys.LOSS} if draws_loss else {}
        self.told: dict[str, Any] = {"dt": dt, "context_keys": context_keys}
        """Arguments that every transform which delays something gets, besides its sampler."""

    @property
    def longest(self) -> int:
        """Longest time until all that corrects a step has arrived: its messages, and its reward
        [steps]."""
        return max(self.obs.longest, self.rew.longest)
