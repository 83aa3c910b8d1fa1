"""Soft actor-critic on TorchRL's losses, from single decisions drawn from a replay buffer."""

import math
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Bounded, Categorical, ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import DiscreteSACLoss, SACLoss, SoftUpdate

from damian import keys
from damian.keys import next_key
from damian.learners.base import UNREAD, LearningSetup
from damian.learners.config import SacConfig
from damian.models.critic import make_action_value
from damian.replay.smdp import find_decisions, transitions
from damian.replay.time_storage import TimeStorage

LOSSES = ("loss_actor", "loss_qvalue", "loss_alpha")
"""Terms of the loss, by their names in TorchRL's losses."""
NUMBERS = (*LOSSES, "alpha", "entropy")
"""Numbers that a round of updates logs; ``alpha`` is the temperature, ``entropy`` in nats."""
N_CRITICS = 2
"""Number of critics, of which the lower value counts."""


class Sac:
    """Soft actor-critic on decisions drawn from a replay buffer, which may be a back-updating
    one."""

    def __init__(
        self, env: EnvBase, config: SacConfig, setup: LearningSetup, buffer: ReplayBuffer | None
    ) -> None:
        assert buffer is not None, "SAC needs a replay buffer on a TimeStorage"
        self.config = config
        self.setup = setup
        self.buffer = buffer
        self.actor = config.make_actor(env, setup.model)
        read = config.critic_keys(setup)
        critics = [make_action_value(env, setup.model, read) for _ in range(N_CRITICS)]
        self.loss = sac_loss(self.actor, critics, env, config)
        # A checkpoint also holds the discount of its run, which must not replace this run's.
        self.loss.register_load_state_dict_post_hook(
            lambda loss, _: loss.make_value_estimator(gamma=config.gamma)
        )
        networks = [
            weights for name, weights in self.loss.named_parameters() if name != "log_alpha"
        ]
        temperature = {"params": [self.loss.log_alpha], "lr": config.alpha_lr}
        self.optimizer = torch.optim.Adam(
            [{"params": networks}, temperature], lr=config.lr, fused=True
        )
        self.targets = SoftUpdate(self.loss, tau=config.tau)
        masked = keys.ACTION_MASK in self.actor.in_keys
        self.observed = ["observation", setup.critic_key[-1], *["action_mask"] * masked]
        # The first message of an episode begins a belief that back-updating computes again.
        believes = keys.BELIEF in env.observation_spec.keys(True)
        self.unread = [key for key in _UNREAD if not (believes and key == keys.MESSAGE)]

    def components(self) -> dict[str, Any]:
        """What a checkpoint stores, besides the replay buffer."""
        return {"actor": self.actor, "critic": self.loss, "optimizer": self.optimizer}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Store a batch [B, T], and make a round of updates; means of ``NUMBERS``, nan before it
        begins."""
        self.buffer.extend(batch.exclude(*self.unread))
        storage = cast(TimeStorage, self.buffer.storage)
        steps = storage.steps
        order = storage.latest()
        settled = order[: max(len(order) - self.setup.settle_steps, 0)]
        ready, ready_next = (
            cast(Tensor, steps[k])[settled] for k in (keys.READY, next_key(keys.READY))
        )
        if (
            valid := steps.get(keys.VALID, None)
        ) is not None:  # not after an end that was known only later
            ready = ready & cast(Tensor, valid)[settled]
        done, terminated = (
            steps[next_key(key)][settled].squeeze(-1) for key in (keys.DONE, keys.TERMINATED)
        )
        decisions = find_decisions(ready, ready_next, done, terminated)
        if len(order) * batch.shape[0] < self.config.warm_up or not len(decisions.begin):
            return dict.fromkeys(NUMBERS, math.nan)
        rounds = []
        for _ in range(self.config.updates):
            sample = decisions.sample(self.config.batch_size)
            numbers = self.update(
                transitions(
                    steps, order, sample, self.config.gamma, self.observed, self.config.team
                )
            )
            rounds.append(torch.stack([numbers[name] for name in NUMBERS]))
        # A number that is read at once would make the device wait at every update.
        return dict(zip(NUMBERS, torch.stack(rounds).double().mean(0).tolist(), strict=True))

    def update(self, batch: TensorDictBase) -> TensorDictBase:
        """Make one update from transitions [K]; returns ``NUMBERS``."""
        losses = self.loss(batch)
        self.optimizer.zero_grad()
        torch.stack([losses[name] for name in LOSSES]).sum().backward()
        self.optimizer.step()
        self.targets.step()
        return losses.detach()


_UNREAD: list[NestedKey] = [
    *UNREAD,
    keys.ACTION_LOG_PROB,
    keys.EPISODE_REWARD,
    keys.MESSAGE,
    keys.RECEIVED,
    keys.DELAY,
    keys.AGE,
    keys.MESSAGE_SENT,
    next_key(keys.REWARD_TERMS),
    next_key(keys.EPISODE_REWARD),
]
"""Entries that SAC never reads; they are not stored, to save memory, unless back-updating reads
them."""


def sac_loss(
    actor: ProbabilisticActor, critics: list[TensorDictModule], env: EnvBase, config: SacConfig
) -> SACLoss | DiscreteSACLoss:
    """Loss with a learnt temperature on single decisions [K] with the keys of ``UavEnv``."""
    spec = env.full_action_spec_unbatched[keys.ACTION]
    # A loop over two critics is faster on a CPU than vmap.
    options: dict[str, Any] = {
        "loss_function": "l2",
        "alpha_init": config.alpha_init,
        "num_qvalue_nets": len(critics),
        "deactivate_vmap": True,
    }
    if isinstance(spec, Categorical):
        loss = MaskedDiscreteSACLoss(actor, critics, spec.n, config.target_entropy, **options)
    else:
        # Target entropy of one UAV: minus its action dimensions on [-1, 1], shifted to its actions'
        # bounds.
        bounds = cast(Bounded, spec)
        width = (bounds.high - bounds.low).reshape(-1, spec.shape[-1])[0]
        target = ((width / 2).log() - 1).sum().item()
        loss = SACLoss(actor, cast(Any, critics), target_entropy=target, **options)
    loss.set_keys(action=keys.ACTION, reward=keys.REWARD)
    loss.make_value_estimator(gamma=config.gamma)
    return loss


class MaskedDiscreteSACLoss(DiscreteSACLoss):
    """Discrete SAC loss with a target entropy for each state: a share of that of its legal
    actions."""

    def __init__(self, actor: Any, critics: Any, n: int, share: float, **options: Any) -> None:
        options |= {"target_entropy": 0.0}  # ``forward`` adds the target itself
        super().__init__(actor, critics, action_space="categorical", num_actions=n, **options)
        self.share = share
        self.n_actions = n

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """TorchRL's losses of transitions [K], by private parts of it, so that critics are
        evaluated once."""
        target = self._compute_target(tensordict)
        evaluate: Any = self._vmap_qnetworkN0
        observed = tensordict.select(*self.qvalue_network.in_keys)
        values = evaluate(observed, self.qvalue_network_params)["action_value"]  # [2, K, A]
        action = tensordict[keys.ACTION].expand(values.shape[:-1]).unsqueeze(-1)
        error = values.gather(-1, action).squeeze(-1) - target
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            policy = self.actor_network.get_dist(tensordict.copy())
        prob = policy.probs
        log_prob = policy.logits
        cost = self._alpha * log_prob - values.detach().amin(0)
        entropy = -(prob * log_prob).sum(-1).detach()
        too_certain = self.target_entropies(tensordict) - entropy
        return TensorDict(
            {
                "loss_actor": (prob * cost).sum(-1).mean(),
                "loss_qvalue": error.square().sum(0).mean(),
                "loss_alpha": -(self.log_alpha * too_certain).mean(),
                "alpha": self._alpha,
                "entropy": entropy.mean(),
            }
        )

    def target_entropies(self, tensordict: TensorDictBase) -> Tensor:
        """Target entropy of each state, [K], or one for all of them if all actions are legal."""
        mask = tensordict.get(keys.ACTION_MASK, None)
        legal = torch.tensor(self.n_actions) if mask is None else mask.sum(-1)
        return self.share * legal.log()
