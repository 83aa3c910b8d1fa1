"""MAPPO on TorchRL's loss, from batches that late messages may have corrected (paper, section 4.3)."""

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
from torchrl.objectives.value.functional import generalized_advantage_estimate

from damian import keys
from damian.common import checks
from damian.learners.base import LEARNERS, LearnerConfig, LearningSetup
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
"""Entries of a step that the loss reads, beside the critic's observation."""


@LEARNERS.register("mappo")
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
    """The gradient is scaled down to this norm if its norm is larger."""
    epochs: int = 4
    """Passes over the batch per update."""
    minibatches: int = 4
    """Minibatches per pass."""
    normalize_advantage: bool = True
    """Whether to scale the advantages of a batch to mean 0 and standard deviation 1."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.above("learner.max_grad_norm", self.max_grad_norm, 0.0)
        checks.in_range("learner.lmbda", self.lmbda, 0.0, 1.0)
        checks.in_range("learner.clip_epsilon", self.clip_epsilon, 0.0, 1.0)  # a ratio is not negative
        for name in ("entropy_coeff", "critic_coeff"):
            checks.in_range(f"learner.{name}", getattr(self, name), 0.0)
        for name in ("epochs", "minibatches"):
            checks.in_range(f"learner.{name}", getattr(self, name), 1, checks.STEPS)

    def check(self, setup: LearningSetup) -> None:
        recurrent, shortest, longest = setup.model.recurrent, setup.shortest_period, setup.longest_delay
        most_minibatches = setup.worlds if recurrent else setup.worlds * shortest
        checks.in_range("learner.minibatches", self.minibatches, 1, most_minibatches)
        should = f"needs more than {longest} steps (the longest delay) between two updates, not {shortest}"
        checks.require(not setup.settle or longest < shortest, "settle", True, should)
        should = "does not go with model.rnn: hidden states are not recomputed from corrected observations"
        checks.require(not (recurrent and setup.recompute_actor), "recompute_actor", True, should)

    def buffer_size(self, setup: LearningSetup) -> int | None:
        if not setup.backupdate:
            return None
        return (setup.longest_period + 2 * setup.longest_delay) * setup.worlds

    def make(self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None) -> "Mappo":
        return Mappo(env, self, setup, buffer)


class Mappo:
    """Multi-agent PPO: learns from each batch once, as soon as it is collected.

    Args:
        env: its specs give the sizes of the networks.
        config: settings of the learner.
        setup: properties of the run.
        buffer: replay buffer on a ``BackupdateStorage``, from which the learner reads the corrected batches.
            None: the learner uses batches as they were collected.
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
        """Networks and optimiser that a checkpoint stores."""
        return {"actor": self.actor, "critic": self.critic, "optimizer": self.optimizer}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Make one update from a batch [B, T]; returns mean losses and the share of back-updated messages."""
        corrected = self.backupdated_batch(batch)
        add_advantages(corrected, self.critic, self.config)
        losses = self.optimize(corrected)
        if self.buffer is None:
            return losses
        return {"backupdated": corrected[keys.BACKUPDATED].float().mean().item(), **losses}

    @torch.no_grad()
    def backupdated_batch(self, batch: TensorDictBase) -> TensorDictBase:
        """Store a batch [B, T], and return it as corrected by all messages that have arrived by now, [B, T].

        With ``settle`` the returned steps are earlier ones: they end ``settle_steps`` before the latest step
        (the first batch is shorter). Steps between the end of an episode and the time at which the server
        learnt of it stay in the batch: until then a UAV must not undo the success.
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
        """Make ``epochs`` passes over a batch [B, T] with advantages; returns the mean losses.

        Minibatches are drawn over steps; for a recurrent actor, over worlds with their whole sequences.
        """
        recurrent = self.setup.model.recurrent
        needed_keys = [*LOSS_KEYS, *self.critic.in_keys, *(RECURRENT_KEYS if recurrent else [])]
        batch = batch.select(*needed_keys, strict=False)  # each entry costs time at every minibatch
        samples = batch if recurrent else batch.reshape(-1)
        sums: dict[str, float] = {}
        n_minibatches = min(self.config.minibatches, len(samples))
        for _ in range(self.config.epochs):
            for index in torch.randperm(len(samples), device=samples.device).tensor_split(n_minibatches):
                losses = minibatch_losses(samples[index], self.loss)
                self.optimizer.zero_grad()
                torch.stack([*losses.values()]).sum().backward()
                torch.nn.utils.clip_grad_norm_(self.loss.parameters(), self.config.max_grad_norm)
                self.optimizer.step()
                for name, value in losses.items():
                    sums[name] = sums.get(name, 0.0) + value.item()
        n_updates = self.config.epochs * n_minibatches
        return {name: total / n_updates for name, total in sums.items()}


def mappo_loss(actor: ProbabilisticActor, critic: TensorDictModule, config: MappoConfig) -> MAPPOLoss:
    """Clipped PPO objective with a centralised critic, with the TensorDict keys of ``UavEnv``."""
    loss = MAPPOLoss(
        actor,
        critic,
        clip_epsilon=config.clip_epsilon,
        entropy_coeff=config.entropy_coeff,
        critic_coeff=config.critic_coeff,
        normalize_advantage=False,  # ``add_advantages`` normalises, over decisions only
        reduction="none",  # ``minibatch_losses`` averages, over decisions only where needed
        log_explained_variance=False,  # it costs time
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

    The return of a decision sums the rewards until the UAV's next decision, k steps later, whose value is
    discounted by gamma^k (a semi-Markov decision process; Sutton, Precup and Singh 1999). Values at the steps
    between two decisions are not used: there lambda of the generalised advantage estimate (Schulman et al.
    2016) is 1. A step at which the UAV was not ready is no decision, and its advantage is 0.
    """
    critic(batch)
    next_step = critic(batch["next"])
    value, next_agents = batch[keys.STATE_VALUE], cast(TensorDictBase, next_step[keys.AGENTS])
    ends = [next_step[key] for key in (keys.DONE, keys.TERMINATED)]
    # Only with ``clock.skip`` do steps have durations other than 1.
    durations = next_step.get(keys.DURATION, torch.ones_like(ends[0], dtype=torch.long))
    gamma, done, terminated = (x.unsqueeze(-2).expand_as(value) for x in (config.gamma**durations, *ends))
    # TorchRL says float, but broadcasts tensors.
    lmbda: Any = torch.where(next_agents["ready"].unsqueeze(-1), config.lmbda, 1.0)
    advantage, batch[keys.VALUE_TARGET] = generalized_advantage_estimate(
        gamma, lmbda, value, next_agents["state_value"], next_agents["reward"], done, terminated, time_dim=-3
    )
    ready = batch[keys.READY].unsqueeze(-1)
    if config.normalize_advantage:
        decisions = advantage[ready] if ready.any() else torch.zeros(1, device=advantage.device)
        advantage = (advantage - decisions.mean()) / decisions.std(correction=0).clamp(min=1e-6)
    batch[keys.ADVANTAGE] = torch.where(ready, advantage, 0.0)


def minibatch_losses(batch: TensorDictBase, loss: MAPPOLoss) -> dict[str, Tensor]:
    """Mean terms of the loss on a batch [*]: actor and entropy over decisions, the critic over all steps.

    The policy also outputs actions for UAVs in flight, but these have no effect.
    """
    terms = loss(batch)
    ready = batch[keys.READY].float()

    def mean_over_decisions(term: Tensor) -> Tensor:
        return (term.view_as(ready) * ready).sum() / ready.sum().clamp(min=1)

    return {
        "loss_objective": mean_over_decisions(terms["loss_objective"]),
        "loss_entropy": mean_over_decisions(terms["loss_entropy"]),
        "loss_critic": terms["loss_critic"].mean(),
    }
