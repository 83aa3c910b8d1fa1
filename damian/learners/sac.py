"""Soft actor-critic made from TorchRL's losses, learning from single decisions; keys are set here only."""

import math
from dataclasses import dataclass
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Bounded, Categorical, ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import DiscreteSACLoss, SACLoss, SoftUpdate

from damian.common import checks
from damian.learners.networks import ModelConfig, make_action_value, make_actor
from damian.replay.backupdate import TimeStorage
from damian.replay.smdp import find_decisions, transitions

LOSSES = ("loss_actor", "loss_qvalue", "loss_alpha", "alpha")


@dataclass
class SacConfig:
    """Soft actor-critic (Haarnoja et al. 2018; discrete: Christodoulou 2019) with one shared policy."""

    lr: float = 1e-3
    """Learning rate of Adam."""
    alpha_lr: float = 1e-2
    """That of the temperature's logarithm, which has to find the scale of the rewards first."""
    gamma: float = 0.95
    """Discount factor of a step."""
    tau: float = 0.01
    """How far the target networks move to the learnt ones at each update."""
    alpha: float = 0.01
    """Temperature to begin with: weight of the entropy."""
    entropy: float = 0.5
    """Entropy that the temperature aims at (discrete actions): share of that of a uniform choice among the
    legal actions of each UAV. Continuous actions aim at minus their dimensions, on [-1, 1]."""
    n_steps: int = 1
    """Decisions whose rewards are summed before a value is estimated (n-step returns)."""
    steps: int = 4
    """Steps of every world between two rounds of learning."""
    updates: int = 4
    """Updates in a round."""
    batch: int = 512
    """Decisions in an update."""
    memory: int = 200_000
    """Latest steps, over all worlds, that are learnt from."""
    warm_up: int = 5_000
    """Steps, over all worlds, before learning begins."""

    def __post_init__(self) -> None:
        for name in ("lr", "alpha_lr", "tau", "alpha"):
            checks.above(f"sac.{name}", getattr(self, name), 0.0)
        for name in ("gamma", "tau", "entropy"):
            checks.in_range(f"sac.{name}", getattr(self, name), 0.0, 1.0)
        for name in ("n_steps", "steps", "updates", "batch", "memory"):
            checks.in_range(f"sac.{name}", getattr(self, name), 1)
        checks.in_range("sac.warm_up", self.warm_up, 0, self.memory)


class Sac:
    """A learner: takes steps as they are collected, and improves its actor on decisions drawn from memory.

    A decision of one UAV is a sample of the one policy that all share, so that steps at which a UAV is not
    ready never enter a loss.

    Args:
        env: for the specs.
        model: of actor and critics.
        config: how to learn.
        memory: buffer on a ``TimeStorage``; on a ``BackupdateStorage``, late messages correct what it holds.
        settle: learn from steps only so many steps later.
        critic_sees: what the critics see of each UAV, beside what its actor does.
    """

    def __init__(
        self,
        env: EnvBase,
        model: ModelConfig,
        config: SacConfig,
        memory: ReplayBuffer,
        settle: int = 0,
        critic_sees: str = "global_observation",
    ) -> None:
        self.config, self.memory, self.settle = config, memory, settle
        self.actor = make_actor(env, model)
        self.loss = sac_loss(self.actor, make_action_value(env, model, critic_sees), env, config)
        # A checkpoint brings what was learnt, not with which discount.
        self.loss.register_load_state_dict_post_hook(
            lambda loss, _: loss.make_value_estimator(gamma=config.gamma)
        )
        networks = [weights for name, weights in self.loss.named_parameters() if name != "log_alpha"]
        temperature = {"params": [self.loss.log_alpha], "lr": config.alpha_lr}
        self.optimizer = torch.optim.Adam([{"params": networks}, temperature], lr=config.lr, fused=True)
        self.targets = SoftUpdate(self.loss, tau=config.tau)
        masked = ("agents", "action_mask") in self.actor.in_keys
        self.seen = ["observation", critic_sees, *["action_mask"] * masked]

    def parts(self) -> dict[str, Any]:
        """What a checkpoint keeps; the memory fills anew."""
        return {"actor": self.actor, "critic": self.loss, "optimizer": self.optimizer}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Remember a batch [B, T], and do a round of updates.

        Returns:
            the mean losses, nan before learning begins.
        """
        self.memory.extend(batch.exclude(*_UNREAD))
        storage = cast(TimeStorage, self.memory.storage)
        steps, order = storage.steps, storage.latest()
        known = order[: max(len(order) - self.settle, 0)]
        ready, then = (cast(Tensor, steps[key])[known] for key in (_READY, ("next", *_READY)))
        done, terminated = (steps["next", key][known].squeeze(-1) for key in ("done", "terminated"))
        decisions = find_decisions(ready, then, done, terminated, self.config.n_steps)
        if len(order) * batch.shape[0] < self.config.warm_up or not len(decisions.begin):
            return dict.fromkeys(LOSSES, math.nan)
        sums = dict.fromkeys(LOSSES, 0.0)
        for _ in range(self.config.updates):
            drawn = decisions.draw(self.config.batch)
            losses = self.improve(transitions(steps, order, drawn, self.config.gamma, self.seen))
            sums = {name: sums[name] + losses[name].item() for name in LOSSES}
        return {name: total / self.config.updates for name, total in sums.items()}

    def improve(self, drawn: TensorDictBase) -> TensorDictBase:
        """One update from transitions [K]; returns the losses."""
        losses = self.loss(drawn)
        self.optimizer.zero_grad()
        (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
        self.optimizer.step()
        self.targets.step()
        return losses.detach()


_READY = ("agents", "ready")
_UNREAD: list[NestedKey] = [
    "collector",
    *(("agents", name) for name in ("logits", "loc", "scale", "action_log_prob", "episode_reward")),
    *(("agents", name) for name in ("message", "received", "delay", "age", "talks")),
    *(("next", "agents", name) for name in ("reward_terms", "episode_reward")),
]
"""Entries of a step that nobody learns from: a memory is large."""


def sac_loss(
    actor: ProbabilisticActor, action_value: TensorDictModule, env: EnvBase, config: SacConfig
) -> SACLoss | DiscreteSACLoss:
    """Two critics, learnt temperature; on single decisions [K] under the keys of ``UavEnv``."""
    spec = env.full_action_spec_unbatched["agents", "action"]
    # A loop over two critics is faster on a CPU than vmap.
    options: dict[str, Any] = {"loss_function": "l2", "alpha_init": config.alpha, "deactivate_vmap": True}
    if isinstance(spec, Categorical):
        loss = MaskedDiscreteSACLoss(actor, action_value, spec.n, config.entropy, **options)
    else:
        # Of one UAV, whose actions lie in bounds of their own instead of [-1, 1].
        bounds = cast(Bounded, spec)
        width = (bounds.high - bounds.low).reshape(-1, spec.shape[-1])[0]
        target = ((width / 2).log() - 1).sum().item()
        loss = SACLoss(actor, action_value, target_entropy=target, **options)
    loss.set_keys(action=("agents", "action"), reward=("agents", "reward"))
    loss.make_value_estimator(gamma=config.gamma)
    return loss


class MaskedDiscreteSACLoss(DiscreteSACLoss):
    """Aims at a share of the entropy of a uniform choice among the actions that are legal in each state.

    One target for all states, as in TorchRL, would lie above what there is wherever few actions are legal.
    """

    def __init__(
        self, actor: ProbabilisticActor, action_value: TensorDictModule, n: int, share: float, **options: Any
    ) -> None:
        zero: Any = 0.0  # of what ``actor_loss`` reports
        super().__init__(
            actor, action_value, action_space="categorical", num_actions=n, target_entropy=zero, **options
        )
        self.share, self.n_actions = share, n

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """TorchRL's; what the temperature sees is by how much each state's entropy misses its target."""
        loss, seen = super().actor_loss(tensordict)
        mask = tensordict.get(("agents", "action_mask"), None)
        legal = torch.tensor(self.n_actions) if mask is None else mask.sum(-1)
        return loss, {"log_prob": seen["log_prob"] + self.share * legal.log()}
