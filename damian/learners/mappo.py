"""MAPPO made from TorchRL's loss, on what the server knows by now; keys are set here only."""

from dataclasses import dataclass
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor
from torchrl.objectives.multiagent import MAPPOLoss
from torchrl.objectives.value.functional import vec_generalized_advantage_estimate

from damian.common import checks
from damian.learners.networks import ModelConfig, make_actor, make_critic
from damian.learners.recurrent import CARRIED
from damian.replay.backupdate import BackupdateStorage

LEARNT: list[NestedKey] = [
    *(("agents", key) for key in ("observation", "action_mask", "action", "action_log_prob", "advantage")),
    *(("agents", key) for key in ("state_value", "value_target", "ready")),
]
"""What the loss reads of a step, beside what the critic sees."""


@dataclass
class MappoConfig:
    """Multi-agent PPO (Yu et al. 2022) with one shared policy."""

    lr: float = 3e-4
    """Learning rate of Adam."""
    gamma: float = 0.95
    """Discount factor."""
    lmbda: float = 0.9
    """Lambda of the generalised advantage estimate."""
    clip: float = 0.2
    """Clipping of the importance ratio."""
    entropy: float = 0.01
    """Weight of the entropy bonus."""
    value: float = 0.5
    """Weight of the critic's loss."""
    max_grad_norm: float = 0.5
    """The gradient's norm is clipped to this."""
    steps: int = 32
    """Steps of every world between two updates."""
    epochs: int = 4
    """Passes over the collected steps in an update."""
    minibatches: int = 4
    """Parts into which a pass is split."""
    normalize_advantage: bool = True
    """Scale the advantages of a batch to mean 0 and deviation 1."""

    def __post_init__(self) -> None:
        for name in ("lr", "max_grad_norm"):
            checks.above(f"mappo.{name}", getattr(self, name), 0.0)
        for name in ("gamma", "lmbda"):
            checks.in_range(f"mappo.{name}", getattr(self, name), 0.0, 1.0)
        for name in ("clip", "entropy", "value"):
            checks.in_range(f"mappo.{name}", getattr(self, name), 0.0)
        for name in ("steps", "epochs", "minibatches"):
            checks.in_range(f"mappo.{name}", getattr(self, name), 1)


class Mappo:
    """A learner: takes batches as they are collected, and improves its actor.

    Args:
        env: for the specs.
        model: of actor and critic.
        config: how to learn.
        memory: buffer on a ``BackupdateStorage``; what is learnt from are the batches as it knows them.
            None: what was perceived.
        settle: learn from steps only so many steps later, [0, those of a batch).
        recompute_actor: the original authors' variant, in which the corrected observations also stand for
            what the actor saw, as if it had chosen its action there.
        critic_sees: what the critic sees of each UAV.
    """

    def __init__(
        self,
        env: EnvBase,
        model: ModelConfig,
        config: MappoConfig,
        memory: ReplayBuffer | None = None,
        settle: int = 0,
        recompute_actor: bool = False,
        critic_sees: str = "global_observation",
    ) -> None:
        self.config, self.memory, self.recurrent = config, memory, model.recurrent
        self.settle, self.recompute_actor = settle, recompute_actor
        self.actor, self.critic = make_actor(env, model), make_critic(env, model, critic_sees)
        self.loss = mappo_loss(self.actor, self.critic, config)
        self.optimizer = torch.optim.Adam(self.loss.parameters(), lr=config.lr)

    def parts(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {"actor": self.actor, "critic": self.critic, "optimizer": self.optimizer}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """One update from a batch [B, T]; returns the mean losses, and what was corrected."""
        known = self.known(batch)
        add_advantages(known, self.critic, self.config)
        losses = self.optimize(known)
        if self.memory is None:
            return losses
        return {"backupdated": known["agents", "backupdated"].float().mean().item(), **losses}

    @torch.no_grad()
    def known(self, batch: TensorDictBase) -> TensorDictBase:
        """A batch [B, T] as the server knows it by now, or an earlier one that has settled meanwhile.

        Steps after an end that the server learnt of late count too: until it does, a UAV must not undo it.
        """
        if self.memory is None:
            return batch
        self.memory.extend(batch)
        storage = cast(BackupdateStorage, self.memory.storage)
        latest = storage.latest(batch.shape[1] + self.settle)
        batch = storage[latest[: len(latest) - self.settle]].transpose(0, 1)
        if self.recompute_actor:
            chosen = self.actor.get_dist(batch).log_prob(batch["agents", "action"])
            batch["agents", "action_log_prob"] = chosen
        return batch

    def optimize(self, batch: TensorDictBase) -> dict[str, float]:
        """Some passes over a batch [B, T] with advantages; returns the mean losses.

        Minibatches are drawn over steps; for an actor that remembers, over worlds with whole sequences.
        """
        keys = [*LEARNT, *self.critic.in_keys, *(CARRIED if self.recurrent else [])]
        batch = batch.select(*keys, strict=False)  # each entry costs time at every minibatch
        steps = batch if self.recurrent else batch.reshape(-1)
        sums: dict[str, float] = {}
        n_parts = min(self.config.minibatches, len(steps))
        for _ in range(self.config.epochs):
            for index in torch.randperm(len(steps), device=steps.device).tensor_split(n_parts):
                losses = losses_of(steps[index], self.loss)
                self.optimizer.zero_grad()
                torch.stack([*losses.values()]).sum().backward()
                torch.nn.utils.clip_grad_norm_(self.loss.parameters(), self.config.max_grad_norm)
                self.optimizer.step()
                for term, value in losses.items():
                    sums[term] = sums.get(term, 0.0) + value.item()
        n_updates = self.config.epochs * n_parts
        return {term: total / n_updates for term, total in sums.items()}


def mappo_loss(actor: ProbabilisticActor, critic: TensorDictModule, config: MappoConfig) -> MAPPOLoss:
    """Clipped PPO objective with a centralised critic, on the keys of ``UavEnv``."""
    loss = MAPPOLoss(
        actor,
        critic,
        clip_epsilon=config.clip,
        entropy_coeff=config.entropy,
        critic_coeff=config.value,
        normalize_advantage=False,  # done in ``add_advantages``, over decisions only
        reduction="none",  # likewise, in ``losses_of``
        log_explained_variance=False,  # which costs time
    )
    loss.set_keys(
        reward=("agents", "reward"),
        action=("agents", "action"),
        value=("agents", "state_value"),
        advantage=("agents", "advantage"),
        value_target=("agents", "value_target"),
        sample_log_prob=("agents", "action_log_prob"),
    )
    return loss


@torch.no_grad()
def add_advantages(batch: TensorDictBase, critic: TensorDictModule, config: MappoConfig) -> None:
    """Write values, advantages and value targets into a batch [B, T], in place.

    What a decision earns is all that comes until the next one, k steps later, discounted by gamma^k (a
    semi-Markov decision process; Sutton, Precup and Singh 1999): in between, nothing is estimated, so that
    there the lambda of the generalised advantage estimate (Schulman et al. 2016) is 1. An entry at which
    the UAV was not ready is no decision: its advantage is 0.
    """
    critic(batch)
    following = critic(batch["next"])
    value, after = batch["agents", "state_value"], cast(TensorDictBase, following["agents"])
    ends = [following[key] for key in ("done", "terminated")]
    lasts = following.get("duration", torch.ones_like(ends[0], dtype=torch.long))  # more with ``clock.skip``
    gamma, done, terminated = (x.unsqueeze(-2).expand_as(value) for x in (config.gamma**lasts, *ends))
    lmbda = torch.where(after["ready"].unsqueeze(-1), config.lmbda, 1.0)
    advantage, batch["agents", "value_target"] = vec_generalized_advantage_estimate(
        gamma, lmbda, value, after["state_value"], after["reward"], done, terminated, time_dim=-3
    )
    ready = batch["agents", "ready"].unsqueeze(-1)
    if config.normalize_advantage:
        chosen = advantage[ready] if ready.any() else torch.zeros(1, device=advantage.device)
        advantage = (advantage - chosen.mean()) / chosen.std(correction=0).clamp(min=1e-6)
    batch["agents", "advantage"] = torch.where(ready, advantage, 0.0)


def losses_of(batch: TensorDictBase, loss: MAPPOLoss) -> dict[str, Tensor]:
    """The parts of the loss on a batch [*]; actor and entropy over decisions only, the critic over all.

    In flight a policy "chooses" too, but nothing follows from it (SPEC 1).
    """
    parts = loss(batch)
    ready = batch["agents", "ready"].float()

    def over_decisions(part: Tensor) -> Tensor:
        return (part.view_as(ready) * ready).sum() / ready.sum().clamp(min=1)

    return {
        "loss_objective": over_decisions(parts["loss_objective"]),
        "loss_entropy": over_decisions(parts["loss_entropy"]),
        "loss_critic": parts["loss_critic"].mean(),
    }
