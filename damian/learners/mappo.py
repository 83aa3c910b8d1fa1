"""MAPPO, from batches that late messages may have corrected (paper, section 4.3)."""

from collections.abc import Iterator, Sequence
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torch.distributions import Distribution
from torch.nn.functional import pad, smooth_l1_loss
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor, TanhNormal, set_recurrent_mode
from torchrl.objectives.value.functional import generalized_advantage_estimate

from damian import keys
from damian.common.compiling import COMPILE_OPTIONS, compiled
from damian.envs.delayed_env import DelayedEnv
from damian.learners.base import UNREAD, LearningSetup, Progress
from damian.learners.config import MappoConfig
from damian.learners.teacher import Teacher
from damian.models.critic import NormalizedValue, make_critic
from damian.models.memory import RECURRENT_KEYS
from damian.replay.backupdate import BackupdateStorage

LOSSES = ("loss_objective", "loss_entropy", "loss_critic", "loss_teacher")
"""Names of the terms of the loss (``mappo_losses``)."""
NUMBERS = ("kl", "clip_fraction", "entropy")
"""Names of the further numbers that ``mappo_losses`` returns."""
LOSS_KEYS: list[NestedKey] = [
    keys.OBSERVATION,
    keys.ACTION_MASK,
    keys.ACTION,
    keys.ACTION_LOG_PROB,
    keys.ADVANTAGE,
    keys.VALUE_TARGET,
    keys.READY,
]
"""Entries of a step that the loss reads, besides the critic's observation."""


class Mappo:
    """Multi-agent PPO, which with a replay ``buffer`` on a ``BackupdateStorage`` reads corrected
    batches."""

    loss_keys: Sequence[NestedKey] = LOSS_KEYS

    def __init__(
        self,
        env: EnvBase,
        config: MappoConfig,
        setup: LearningSetup,
        buffer: ReplayBuffer | None = None,
    ) -> None:
        self.config = config
        self.setup = setup
        self.buffer = buffer
        self.progress = Progress()
        self.actor = config.make_actor(env, setup.model)
        self.critic = make_critic(env, setup.model, setup.critic_key, config.normalize_value)
        self.weights = [*self.actor.parameters(), *self.critic.parameters()]
        observed = setup.recompute_actor or setup.critic_key == keys.OBSERVATION
        unread = [keys.ACTION_MASK] if observed else [keys.ACTION_MASK, keys.OBSERVATION]
        self.unread = [*UNREAD, *map(keys.next_key, unread)]
        self.optimizer = torch.optim.Adam(self.weights, lr=config.lr, fused=True)
        self.teacher = None
        if config.teacher is not None:
            worlds = cast(DelayedEnv, env).uav_env
            self.teacher = Teacher(worlds, config.teacher, compile=setup.compile)
        # Compiling a recurrent actor, whose loop over time becomes one graph, takes many minutes.
        compiles = setup.compile and not setup.model.recurrent
        self.losses = compiled(self._losses, options=COMPILE_OPTIONS) if compiles else self._losses

    def components(self) -> dict[str, Any]:
        """What a checkpoint stores: networks, optimiser and progress."""
        found = {"actor": self.actor, "critic": self.critic, "optimizer": self.optimizer}
        return found | {"progress": self.progress}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Make one update from a batch [B, T]; also logs ``explained_variance`` and
        ``backupdated``."""
        corrected = self.backupdated_batch(batch)
        executed = None
        if delay := self.config.credit_delay(self.setup):
            corrected, executed = executed_choices(corrected, delay)
        add_advantages(corrected, self.critic, self.config, executed)
        if self.teacher and self._imitation() > 0:
            corrected[keys.TEACHER_ACTION] = self.teacher(corrected)
        numbers = self.optimize(corrected)
        if self.teacher is None:
            del numbers["loss_teacher"]
        self.progress.updates += 1
        self.progress.frames += batch.numel()
        numbers["explained_variance"] = explained_variance(corrected).item()
        if self.buffer is None:
            return numbers
        backupdated = corrected[keys.BACKUPDATED].float().mean()
        return {"backupdated": backupdated.item(), **numbers}

    @torch.no_grad()
    def backupdated_batch(self, batch: TensorDictBase) -> TensorDictBase:
        """Store a batch [B, T], and return it as corrected by all messages that have arrived by
        now, [B, T].

        With ``settle`` the returned steps end ``settle_steps`` before the latest step. Steps
        between the end of an episode and the time at which the server learnt of it stay: until then
        a UAV must not undo the success.
        """
        if self.buffer is None:
            return batch
        storage = cast(BackupdateStorage, self.buffer.storage)
        settle = self.setup.settle_steps
        self.buffer.extend(batch.exclude(*self.unread))
        latest = storage.latest(batch.shape[1] + settle)
        settled = latest[: len(latest) - settle]
        batch = storage[settled].transpose(0, 1)
        if self.setup.recompute_actor:
            policy = self.actor.get_dist(batch)
            batch[keys.ACTION_LOG_PROB] = policy.log_prob(batch[keys.ACTION])
        return batch

    def _weights_of_losses(self) -> list[float]:
        """Factors of ``LOSSES`` in this update."""
        imitation = self._imitation()
        moves = float(self.progress.updates >= self.config.warm_up and imitation < 1)
        return [moves, moves * self._left(), 1.0, imitation]

    def _imitation(self) -> float:
        """Weight of the imitation loss in this update."""
        if self.teacher is None:
            return 0.0
        fades = (self.progress.frames - self.config.imitate) / self.config.teacher_fades
        return min(max(1 - fades, 0.0), 1.0)

    def _left(self) -> float:
        """What is left of the learning rate and of the entropy bonus, a share."""
        if not self.config.anneal:
            return 1.0
        return max(1 - self.progress.frames / self.setup.frames, 0.0)

    def optimize(self, batch: TensorDictBase) -> dict[str, float]:
        """Make ``epochs`` passes over a batch [B, T]; means of ``LOSSES``, ``NUMBERS``,
        ``gradient_norm``."""
        terms = []
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.lr * self._left()
        weights = torch.tensor(self._weights_of_losses(), device=batch.device)
        for entries in self._minibatches(batch):
            losses, numbers = self.losses(entries)
            self.optimizer.zero_grad()
            losses = losses * weights
            losses.sum().backward()
            norm = torch.nn.utils.clip_grad_norm_(self.weights, self.config.max_grad_norm)
            self.optimizer.step()
            terms.append(torch.cat([losses.detach(), numbers, norm.view(1)]))
        # A number that is read at once would make the device wait at every minibatch.
        means = torch.stack(terms).double().mean(0)
        names = (*LOSSES, *NUMBERS, "gradient_norm")
        return dict(zip(names, means.tolist(), strict=True))

    def _minibatches(self, batch: TensorDictBase) -> Iterator[dict[NestedKey, Tensor]]:
        """Entries that the loss reads, for each minibatch of each pass over a batch [B, T]."""
        recurrent = self.setup.model.recurrent
        read = [*self.loss_keys, keys.TEACHER_ACTION, *self.critic.in_keys]
        if recurrent:
            read += RECURRENT_KEYS
        samples = {}
        for key in read:
            entry = batch.get(key, None)
            if entry is not None:
                samples[key] = entry if recurrent else entry.flatten(0, 1)
        ready = samples[keys.READY]
        n_samples = len(ready)
        n_minibatches = min(self.config.minibatches, n_samples)
        for _ in range(self.config.epochs):
            order = torch.randperm(n_samples, device=ready.device)
            parts = {}
            for key, entry in samples.items():
                shuffled = entry.index_select(0, order)
                parts[key] = shuffled.tensor_split(n_minibatches)
            for i in range(n_minibatches):
                yield {key: part[i] for key, part in parts.items()}

    def _losses(self, entries: dict[NestedKey, Tensor]) -> tuple[Tensor, Tensor]:
        return mappo_losses(entries, self.actor, self.critic, self.config)


def mappo_losses(
    entries: dict[NestedKey, Tensor],
    actor: ProbabilisticActor,
    critic: TensorDictModule,
    config: MappoConfig,
) -> tuple[Tensor, Tensor]:
    """Mean terms of the loss on steps [*], named in ``LOSSES``, [4], and what ``NUMBERS`` names,
    [3].

    The terms of the loss are the clipped objective of PPO and the entropy (Schulman et al. 2017),
    over decisions, the error of the critic, over all steps, and the cross-entropy to what a teacher
    would choose, over decisions. The numbers are means over
    decisions: an estimate of the Kullback-Leibler divergence from the policy that collected the
    steps (ratio - 1 - log ratio), the share of importance ratios beyond the clipping, and the
    entropy [nats].

    The ``entries`` by key, what the networks read and ``LOSS_KEYS``, are not a TensorDict, so that
    a compiled function works with any number of steps; for a recurrent actor they are sequences
    [B, T].
    """
    ready = entries[keys.READY].float()
    steps = TensorDict(cast(Any, entries), ready.shape[:-1])
    policy, log_ratio, entropy = policy_terms(steps, actor)
    ratio = log_ratio.exp()
    advantage = entries[keys.ADVANTAGE].squeeze(-1)
    epsilon = config.clip_epsilon
    clipped = ratio.clamp(1 - epsilon, 1 + epsilon)
    objective = torch.minimum(ratio * advantage, clipped * advantage)
    n_decisions = ready.sum().clamp(min=1)
    scale = value_scale(critic)
    mean_entropy = (entropy * ready).sum() / n_decisions
    value = critic(steps)[keys.STATE_VALUE]
    target = entries[keys.VALUE_TARGET]
    error = smooth_l1_loss(value / scale, target / scale)
    imitation = torch.zeros_like(error)
    if keys.TEACHER_ACTION in entries:
        likely = policy.log_prob(entries[keys.TEACHER_ACTION])
        imitation = -(likely * ready).sum() / n_decisions
    losses = [
        -(objective * ready).sum() / n_decisions,
        -config.entropy_coeff * mean_entropy,
        config.critic_coeff * error,
        imitation,
    ]
    with torch.no_grad():
        divergence = (ratio - 1 - log_ratio) * ready
        beyond = ((ratio - 1).abs() > epsilon) * ready
        sums = torch.stack([divergence.sum(), beyond.sum()])
        means = sums / n_decisions
    numbers = torch.cat([means, mean_entropy.detach().view(1)])
    return torch.stack(losses), numbers


def policy_terms(
    steps: TensorDictBase, actor: ProbabilisticActor
) -> tuple[Distribution, Tensor, Tensor]:
    """The policies on steps [*], log-ratios of importance, and entropies (estimated by one draw if
    continuous), [*, N]."""
    with set_recurrent_mode(True):
        policy = actor.get_dist(steps)
    log_ratio = policy.log_prob(steps[keys.ACTION]) - steps[keys.ACTION_LOG_PROB]
    if isinstance(policy, TanhNormal):
        _, log_prob = policy.rsample_and_log_prob()
        return policy, log_ratio, -log_prob
    return policy, log_ratio, policy.entropy()


def executed_choices(batch: TensorDictBase, delay: int) -> tuple[TensorDictBase, Tensor]:
    """The choices of a batch [B, T] whose actions have been executed by its end, ``delay`` steps
    later, [B, T - delay], each with the reward and the end of the episode of that later step.

    Also tells which choices count, [B, T - delay] bool: before the action of the others is
    executed, their episode has ended.
    """
    n_steps = batch.shape[1] - delay
    done = batch[keys.next_key(keys.DONE)].squeeze(-1)
    executed = ~done[:, :-1].unfold(1, delay, 1).any(-1)
    choices = cast(TensorDictBase, batch[:, :n_steps]).copy()
    for key in map(keys.next_key, (keys.REWARD, keys.DONE, keys.TERMINATED)):
        choices[key] = cast(Tensor, batch[key])[:, delay:]
    choices[keys.READY] = choices[keys.READY] & executed.unsqueeze(-1)
    return choices, executed


@torch.no_grad()
def add_advantages(
    batch: TensorDictBase,
    critic: TensorDictModule,
    config: MappoConfig,
    executed: Tensor | None = None,
) -> None:
    """Write values, advantages and value targets into a batch [B, T], in place.

    The return of a decision sums the rewards until the UAV's next decision, k steps later, whose
    value is discounted by gamma^k (a semi-Markov decision process; Sutton, Precup and Singh 1999).
    At the steps between two decisions lambda of the generalised advantage estimate
    (Schulman et al. 2016) is 1, and the advantage is 0. Where ``executed`` [B, T] is false
    (``executed_choices``), there is nothing to learn: the target is the value.
    """
    next_step = cast(TensorDictBase, batch["next"])
    value, next_value = state_values(batch, critic)
    batch[keys.STATE_VALUE] = value
    next_step[keys.STATE_VALUE] = next_value
    flags = next_step[keys.DONE], next_step[keys.TERMINATED]
    ends = (flag.unsqueeze(-2).expand_as(value) for flag in flags)
    # TorchRL says float, but broadcasts tensors.
    decides_next = next_step[keys.READY].unsqueeze(-1)
    lmbda: Any = torch.where(decides_next, config.lmbda, 1.0)
    reward = next_step[keys.REWARD]
    if config.team:
        reward = torch.lerp(reward, reward.mean(-2, keepdim=True), config.team)
    advantage, target = generalized_advantage_estimate(
        config.gamma, lmbda, value, next_value, reward, *ends, time_dim=-3
    )
    if executed is not None:
        target = torch.where(executed[..., None, None], target, value)
    batch[keys.VALUE_TARGET] = target
    if isinstance(critic.module, NormalizedValue):
        critic.module.norm.update(target.double())
    ready = batch[keys.READY].unsqueeze(-1)
    if config.normalize_advantage:
        decisions = advantage[ready] if ready.any() else advantage.new_zeros(1)
        centred = advantage - decisions.mean()
        scale = decisions.std(correction=0).clamp(min=1e-6)
        advantage = centred / scale
    else:
        advantage = advantage / value_scale(critic)
    batch[keys.ADVANTAGE] = torch.where(ready, advantage, 0.0)


def value_scale(critic: TensorDictModule) -> Tensor | float:
    """Running standard deviation of a critic's value targets, [1]; 1 if its values are not
    normalised."""
    if not isinstance(critic.module, NormalizedValue):
        return 1.0
    return critic.module.norm.scale().float()


def explained_variance(batch: TensorDictBase) -> Tensor:
    """Share of the variance of a batch's value targets that its values explain, []; nan if there is
    none."""
    target = batch[keys.VALUE_TARGET].double()
    variance = target.var(correction=0)
    left = target - batch[keys.STATE_VALUE]
    explained = 1 - left.var(correction=0) / variance
    return torch.where(variance > 0, explained, torch.nan)


def state_values(batch: TensorDictBase, critic: TensorDictModule) -> tuple[Tensor, Tensor]:
    """Values before and after each step of a batch [B, T], [B, T, N, 1]; equal observations count
    once."""
    (key,) = critic.in_keys
    before = cast(Tensor, batch[key])
    after = cast(Tensor, batch[keys.next_key(key)])
    equal = after[:, :-1].eq(before[:, 1:])
    followed = equal.flatten(2).all(-1)
    alone = pad(~followed, (0, 1), value=True)  # no step follows the last one
    observed = torch.cat([before.flatten(0, 1), after[alone]])
    once = TensorDict({key: observed}, [len(observed)])
    values = critic(once)[keys.STATE_VALUE]
    n_steps = batch.numel()
    value = values[:n_steps].view(*batch.shape, *values.shape[1:])
    next_value = value.roll(-1, 1)
    next_value[alone] = values[n_steps:]
    return value, next_value
