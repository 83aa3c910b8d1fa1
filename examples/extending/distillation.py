"""Your own learner: a student with late observations imitates a teacher without.

The teacher needs a simulator.

    damian train scenario=tracking hydra.run.dir=runs/teacher
    cd examples/extending
    damian train scenario=tracking delay=paper aware=history learner=distillation:DistillationConfig \\
        learner.teacher=../../runs/teacher

The student collects with its own policy, so that it learns where it goes itself
(DAgger; Ross et al. 2011). It learns to choose as the teacher would, who is shown each step as if
nothing were late. The teacher acts on what the student cannot always infer, and its steps of
training count too.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase

from damian import LearnerConfig, LearningSetup, keys, make_env
from damian.common import checks
from damian.recipes.shared.runs import stored_config
from damian.runs.training_state import load_networks

OFFSET = 2  # last columns of the privileged observation: the true way to the source, which no teacher sees


@dataclass
class DistillationConfig(LearnerConfig):
    """Settings of the student."""

    teacher: str = ""
    """Run folder of the teacher, which was trained without delay."""
    lr: float = 1e-3
    """Learning rate of Adam."""
    epochs: int = 4
    """Passes over each batch."""
    minibatches: int = 16
    """Minibatches of each pass."""

    reads: ClassVar[tuple[str, ...]] = ("privileged",)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("epochs", "minibatches"):
            checks.in_range(f"learner.{name}", getattr(self, name), 1, checks.STEPS)

    def make(
        self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None
    ) -> "Distillation":
        return Distillation(env, self, setup)


class Distillation:
    """Brings the student's choices near the teacher's, by the Kullback-Leibler divergence between
    them."""

    def __init__(self, env: EnvBase, config: DistillationConfig, setup: LearningSetup) -> None:
        self.config = config
        self.teacher = load_teacher(config.teacher, env)
        self.actor = config.make_actor(env, setup.model)
        self.optimizer = torch.optim.Adam(self.actor.parameters(), lr=config.lr)

    def components(self) -> dict[str, Any]:
        return {"actor": self.actor, "optimizer": self.optimizer}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        undelayed = {keys.OBSERVATION: batch[keys.PRIVILEGED_OBSERVATION][..., :-OFFSET]}
        if keys.ACTION_MASK in batch.keys(True):
            undelayed[keys.ACTION_MASK] = batch[keys.ACTION_MASK]
        with torch.no_grad():
            wanted = self.teacher.get_dist(TensorDict(undelayed, batch.batch_size)).logits
        steps = batch.select(keys.OBSERVATION, keys.ACTION_MASK, keys.READY, strict=False)
        steps = steps.set("wanted", wanted).flatten(0, 1)
        divergence = []
        for _ in range(self.config.epochs):
            for part in torch.randperm(len(steps)).tensor_split(self.config.minibatches):
                divergence.append(self.step(steps[part]))
        return {"divergence": sum(divergence) / len(divergence)}

    def step(self, steps: TensorDictBase) -> float:
        """Make one step of gradient descent on steps [K]; returns the mean divergence before it
        [nats]."""
        ready, wanted = (
            steps[keys.READY].float(),
            steps["wanted"],
        )  # a UAV in flight chooses nothing
        divergence = (wanted.exp() * (wanted - self.actor.get_dist(steps).logits)).sum(-1)
        loss = (divergence * ready).sum() / ready.sum().clamp(min=1)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return loss.item()


def load_teacher(folder: str, env: EnvBase) -> Any:
    """The actor of a run without delay, which observes what the critic observes as if nothing were
    late."""
    key = "learner.teacher"
    checks.require(
        bool(folder), key, "''", "is missing: the run folder of a policy trained without delay"
    )
    config = stored_config(Path(folder), key)
    checks.require(
        not config.make_delays().obs.late, key, folder, "was trained with delayed messages"
    )
    world = make_env(config, 1, device=env.device)
    spec = env.full_action_spec_unbatched[keys.ACTION]
    wanted = world.full_action_spec_unbatched[keys.ACTION]
    should = "chooses from other actions, or from continuous ones"
    checks.require(getattr(spec, "n", 0) == getattr(wanted, "n", None), key, folder, should)
    n_seen = world.observation_spec[keys.OBSERVATION].shape[-1]
    n_known = env.observation_spec[keys.PRIVILEGED_OBSERVATION].shape[-1] - OFFSET
    should = (
        f"observes {n_seen} numbers, but the critic of this run {n_known}: choose the same features"
    )
    checks.require(n_seen == n_known, key, folder, should)
    actor = config.learner.make_actor(world, config.model)
    load_networks(Path(folder), key, {"actor": actor})
    return actor.requires_grad_(False)
