"""Belief projection-based Q-learning: SAC whose critics read the state once it has arrived."""

from dataclasses import dataclass

from tensordict import NestedKey
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase

from damian import keys
from damian.common import checks
from damian.learners.base import LEARNERS, LearningSetup
from damian.learners.sac import Sac, SacConfig


@LEARNERS.register("bpql")
@dataclass
class BpqlConfig(SacConfig):
    """BPQL (Kim et al. 2023): soft actor-critic with critics that are free of delay.

    The actor reads the newest observation that has arrived and its own actions since (``aware=both``). The
    critics read nothing but the state in which the action was chosen, which the replay buffer knows by the
    time of learning: Q(s, a), with a from the policy at what the actor observed. Those of ``learner=sac``
    also read what the actor observed. A step is learnt from when all of its messages must have arrived, as
    with ``settle=true``.

    The state is the entry ``LearningSetup.critic_key``. It has no actions that wait for their execution: with
    ``delay.act`` the critics do not know these.
    """

    name: str = "bpql"

    def critic_keys(self, setup: LearningSetup) -> list[NestedKey]:
        return [setup.critic_key]

    def check(self, setup: LearningSetup) -> None:
        super().check(setup)
        true = setup.longest_delay == 0 or setup.backupdate or setup.critic_key != keys.GLOBAL_OBSERVATION
        should = "needs back-updating, which gives its critics the states that have arrived: aware=both"
        checks.require(true, "learner", self.name, should)

    def make(self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None) -> Sac:
        return super().make(env, setup._replace(settle=True), buffer)
