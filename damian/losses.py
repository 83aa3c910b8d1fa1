"""MAPPO made from TorchRL's loss; keys are set here only."""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.modules import ProbabilisticActor
from torchrl.objectives.multiagent import MAPPOLoss
from torchrl.objectives.utils import ValueEstimators

from damian import checks


@dataclass
class MappoConfig:
    """Multi-agent PPO (Yu et al. 2022) with one shared policy."""

    name: str = "mappo"
    """The algorithm."""
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
        checks.one_of("algo.name", self.name, ["mappo"])
        for name in ("lr", "max_grad_norm"):
            checks.above(f"algo.{name}", getattr(self, name), 0.0)
        for name in ("gamma", "lmbda"):
            checks.in_range(f"algo.{name}", getattr(self, name), 0.0, 1.0)
        for name in ("clip", "entropy", "value"):
            checks.in_range(f"algo.{name}", getattr(self, name), 0.0)
        for name in ("steps", "epochs", "minibatches"):
            checks.in_range(f"algo.{name}", getattr(self, name), 1)


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
    )
    loss.set_keys(
        reward=("agents", "reward"),
        action=("agents", "action"),
        value=("agents", "state_value"),
        advantage=("agents", "advantage"),
        value_target=("agents", "value_target"),
        sample_log_prob=("agents", "action_log_prob"),
    )
    loss.make_value_estimator(ValueEstimators.MAGAE, gamma=config.gamma, lmbda=config.lmbda)
    return loss


@torch.no_grad()
def add_advantages(batch: TensorDictBase, loss: MAPPOLoss, config: MappoConfig) -> None:
    """Write advantages and value targets into a batch [B, T], in place.

    An entry at which the UAV was not ready is no decision: its advantage is 0, so nothing is learnt from
    what the policy "chose" there.
    """
    loss.value_estimator(batch)
    advantage = batch["agents", "advantage"]
    ready = batch["agents", "ready"].unsqueeze(-1)
    if config.normalize_advantage:
        chosen = advantage[ready] if ready.any() else torch.zeros(1, device=advantage.device)
        advantage = (advantage - chosen.mean()) / chosen.std(correction=0).clamp(min=1e-6)
    batch["agents", "advantage"] = torch.where(ready, advantage, 0.0)


def losses_of(batch: TensorDictBase, loss: MAPPOLoss) -> dict[str, Tensor]:
    """The parts of the loss on a batch [M]; actor and entropy over decisions only, the critic over all.

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
