"""Settings of the programs that fly one policy: which one, a stored or a scripted one."""

from dataclasses import dataclass
from typing import ClassVar

from damian.common import checks

from .settings import TrainConfig

STORED = ("sampled", "deterministic")


@dataclass
class FlownPolicyConfig(TrainConfig):
    """All settings of ``damian train``, and which policy flies."""

    policies: ClassVar[tuple[str, ...]] = STORED
    """The policies that the program knows; the first of them flies a checkpoint if none is chosen."""

    policy: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.policy is None:
            return
        checks.one_of("policy", self.policy, self.policies)
        stored = "|".join(name for name in self.policies if name in STORED)
        should = f"flies no checkpoint: choose policy={stored}, or leave out checkpoint"
        checks.require(self.learnt or not self.checkpoint, "policy", self.policy, should)
        should = "needs checkpoint: the run folder with the policy to fly"
        checks.require(bool(self.checkpoint) or not self.learnt, "policy", self.policy, should)

    @property
    def flown(self) -> str:
        """The policy that flies, one of ``policies``."""
        return self.policy or (self.policies[0] if self.checkpoint else "script")

    @property
    def learnt(self) -> bool:
        """Whether it is that of a checkpoint."""
        return self.flown in STORED
