"""MAPPO made from TorchRL's loss, on what the server knows by the time of learning."""

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

from damian import keys
from damian.common import checks
from damian.learners.base import LearnerConfig, LearningSetup
from damian.learners.networks import make_actor, make_critic
from damian.learners.recurrent import RECURRENT_KEYS
from damian.replay.backupdate import BackupdateStorage

LOSS_KEYS: list[NestedKey] = [
    keys.OBSERVATION,
    keys.ACTION_MASK,
    keys.ACTION,
    keys.ACTION_LOG_PROB,
    keys.ADVANTAGE,
    keys.STATE_VALUE,
    keys.VALUE_TARGET,
    keys.READY,
]
"""Entries of a step that the loss reads, beside what the critic sees."""


@dataclass
class MappoConfig(LearnerConfig):
    """Multi-agent PPO (Yu et al. 2022) with one shared policy."""

    name: str = "mappo"
    lmbda: float = 0.9
    """Lambda of the generalised advantage estimate."""
    clip_epsilon: float = 0.2
    """Clipping of the importance ratio."""
    entropy_coeff: float = 0.01
    """Weight of the entropy bonus."""
    critic_coeff: float = 0.5
    """Weight of the critic's loss."""
    max_grad_norm: float = 0.5
    """The gradient's norm is clipped to this."""
    epochs: int = 4
    """Passes over the collected steps in an update."""
    minibatches: int = 4
    """Parts into which a pass is split."""
    normalize_advantage: bool = True
    """Scale the advantages of a batch to mean 0 and deviation 1."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.above("learner.max_grad_norm", self.max_grad_norm, 0.0)
        checks.in_range("learner.lmbda", self.lmbda, 0.0, 1.0)
        for name in ("clip_epsilon", "entropy_coeff", "critic_coeff"):
            checks.in_range(f"learner.{name}", getattr(self, name), 0.0)
        for name in ("epochs", "minibatches"):
            checks.in_range(f"learner.{name}", getattr(self, name), 1)

    def check(self, setup: LearningSetup) -> None:
        recurrent, shortest, longest = setup.model.recurrent, setup.shortest_period, setup.longest_delay
        most = setup.worlds if recurrent else setup.worlds * shortest
        checks.in_range("learner.minibatches", self.minibatches, 1, most)
        should = f"needs more than {longest} steps, the longest delay, between two updates: {shortest}"
        checks.require(not setup.settle or longest < shortest, "settle", True, should)
        should = "does not go with model.rnn: the hidden states of a UAV are not recomputed"
        checks.require(not (recurrent and setup.recompute_actor), "recompute_actor", True, should)

    def buffer_size(self, setup: LearningSetup) -> int | None:
        if not setup.backupdate:
            return None
        return (setup.longest_period + 2 * setup.longest_delay) * setup.worlds

    def make(self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None) -> "Mappo":
        return Mappo(env, self, setup, buffer)


class Mappo:
    """Learns from each batch once, as soon as it is collected.

    Args:
        env: for its specs.
        config: how to learn.
        setup: of the run.
        buffer: replay buffer on a ``BackupdateStorage``: the learner takes its corrected batches. None:
            batches as they were collected.
    """

    def __init__(
        self, env: EnvBase, config: MappoConfig, setup: LearningSetup, buffer: ReplayBuffer | None = None
    ) -> None:
        self.config, self.setup, self.buffer = config, setup, buffer
        self.actor = make_actor(env, setup.model)
        self.critic = make_critic(env, setup.model, setup.critic_key)
        self.loss = mappo_loss(self.actor, self.critic, config)
        self.optimizer = torch.optim.Adam(self.loss.parameters(), lr=config.lr)

    def components(self) -> dict[str, Any]:
        """Networks and optimiser that a checkpoint keeps."""
        return {"actor": self.actor, "critic": self.critic, "optimizer": self.optimizer}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """One update from a batch [B, T]; returns the mean losses, and the share of back-updated messages."""
        corrected = self.backupdated_batch(batch)
        add_advantages(corrected, self.critic, self.config)
        losses = self.optimize(corrected)
        if self.buffer is None:
            return losses
        return {"backupdated": corrected[keys.BACKUPDATED].float().mean().item(), **losses}

    @torch.no_grad()
    def backupdated_batch(self, batch: TensorDictBase) -> TensorDictBase:
        """A batch [B, T] as the server knows it by now, or an earlier one that has settled meanwhile.

        Steps after an end that the server learnt of late stay in it: until the server does, a UAV must not
        undo the success.
        """
        if self.buffer is None:
            return batch
        self.buffer.extend(batch)
        storage, settle = cast(BackupdateStorage, self.buffer.storage), self.setup.settle_steps
        latest = storage.latest(batch.shape[1] + settle)
        batch = storage[latest[: len(latest) - settle]].transpose(0, 1)
        if self.setup.recompute_actor:
            batch[keys.ACTION_LOG_PROB] = self.actor.get_dist(batch).log_prob(batch[keys.ACTION])
        return batch

    def optimize(self, batch: TensorDictBase) -> dict[str, float]:
        """Some passes over a batch [B, T] with advantages; returns the mean losses.

        Minibatches are drawn over steps; for a recurrent actor, over worlds with their whole sequences.
        """
        recurrent = self.setup.model.recurrent
        read = [*LOSS_KEYS, *self.critic.in_keys, *(RECURRENT_KEYS if recurrent else [])]
        batch = batch.select(*read, strict=False)  # each entry costs time at every minibatch
        steps = batch if recurrent else batch.reshape(-1)
        sums: dict[str, float] = {}
        n_parts = min(self.config.minibatches, len(steps))
        for _ in range(self.config.epochs):
            for index in torch.randperm(len(steps), device=steps.device).tensor_split(n_parts):
                losses = minibatch_losses(steps[index], self.loss)
                self.optimizer.zero_grad()
                torch.stack([*losses.values()]).sum().backward()
                torch.nn.utils.clip_grad_norm_(self.loss.parameters(), self.config.max_grad_norm)
                self.optimizer.step()
                for name, value in losses.items():
                    sums[name] = sums.get(name, 0.0) + value.item()
        n_updates = self.config.epochs * n_parts
        return {name: total / n_updates for name, total in sums.items()}


def mappo_loss(actor: ProbabilisticActor, critic: TensorDictModule, config: MappoConfig) -> MAPPOLoss:
    """Clipped PPO objective with a centralised critic, on the keys of ``UavEnv``."""
    loss = MAPPOLoss(
        actor,
        critic,
        clip_epsilon=config.clip_epsilon,
        entropy_coeff=config.entropy_coeff,
        critic_coeff=config.critic_coeff,
        normalize_advantage=False,  # done in ``add_advantages``, over decisions only
        reduction="none",  # likewise, in ``minibatch_losses``
        log_explained_variance=False,  # which costs time
    )
    loss.set_keys(
        reward=keys.REWARD,
        action=keys.ACTION,
        value=keys.STATE_VALUE,
        advantage=keys.ADVANTAGE,
        value_target=keys.VALUE_TARGET,
        sample_log_prob=keys.ACTION_LOG_PROB,
    )
    return loss


@torch.no_grad()
def add_advantages(batch: TensorDictBase, critic: TensorDictModule, config: MappoConfig) -> None:
    """Write values, advantages and value targets into a batch [B, T], in place.

    The return of a decision is all that is earned until the next one, k steps later, discounted by gamma^k (a
    semi-Markov decision process; Sutton, Precup and Singh 1999): in between no value is estimated, so that
    there the lambda of the generalised advantage estimate (Schulman et al. 2016) is 1. A step at which the
    UAV was not ready is no decision: its advantage is 0.
    """
    critic(batch)
    following = critic(batch["next"])
    value, after = batch[keys.STATE_VALUE], cast(TensorDictBase, following[keys.AGENTS])
    ends = [following[key] for key in (keys.DONE, keys.TERMINATED)]
    durations = following.get(
        keys.DURATION, torch.ones_like(ends[0], dtype=torch.long)
    )  # with ``clock.skip``
    gamma, done, terminated = (x.unsqueeze(-2).expand_as(value) for x in (config.gamma**durations, *ends))
    lmbda = torch.where(after["ready"].unsqueeze(-1), config.lmbda, 1.0)
    advantage, batch[keys.VALUE_TARGET] = vec_generalized_advantage_estimate(
        gamma, lmbda, value, after["state_value"], after["reward"], done, terminated, time_dim=-3
    )
    ready = batch[keys.READY].unsqueeze(-1)
    if config.normalize_advantage:
        decisions = advantage[ready] if ready.any() else torch.zeros(1, device=advantage.device)
        advantage = (advantage - decisions.mean()) / decisions.std(correction=0).clamp(min=1e-6)
    batch[keys.ADVANTAGE] = torch.where(ready, advantage, 0.0)


def minibatch_losses(batch: TensorDictBase, loss: MAPPOLoss) -> dict[str, Tensor]:
    """The terms of the loss on a batch [*]: actor and entropy over decisions only, the critic over all steps.

    The policy also outputs an action for a UAV in flight, but that action has no effect.
    """
    terms = loss(batch)
    ready = batch[keys.READY].float()

    def over_decisions(term: Tensor) -> Tensor:
        return (term.view_as(ready) * ready).sum() / ready.sum().clamp(min=1)

    return {
        "loss_objective": over_decisions(terms["loss_objective"]),
        "loss_entropy": over_decisions(terms["loss_entropy"]),
        "loss_critic": terms["loss_critic"].mean(),
    }
