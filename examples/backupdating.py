"""Late messages make stored rewards wrong, and a replay buffer corrects them when the messages
arrive.

    python examples/backupdating.py        (a few seconds)

Tanks far away send their water levels to a control room, where a message arrives three to seven
steps later. The room computes rewards from the newest message that it holds, and ends an episode
when it hears that a tank has overflowed: both tell of an earlier level. The replay buffer computes
them again for each stored step that a message concerns, once that message has arrived.
docs/backupdating.md explains each part.
"""

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import Bounded, Composite, ReplayBuffer, Unbounded
from torchrl.envs import Compose, EnvBase, StepCounter, Transform, TransformedEnv

from damian import BackupdateStorage, ObservationDelay, Uniform

WORLDS = 16
BATCH_STEPS = 20
BATCHES = 30
MAX_STEPS = 60


class Tanks(EnvBase):
    """B tanks, from which water flows at random; the action in [0, 1] lets water in."""

    def __init__(self, n_worlds: int) -> None:
        super().__init__(batch_size=[n_worlds])
        self.observation_spec = Composite(message=Unbounded((n_worlds, 2)), shape=[n_worlds])
        self.action_spec = Bounded(0.0, 1.0, (n_worlds, 1))
        self.reward_spec = Unbounded((n_worlds, 1))
        self.message = torch.zeros(n_worlds, 2)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        mask = (
            torch.tensor(True)
            if tensordict is None
            else tensordict.get("_reset", torch.tensor(True))
        )
        self.message = torch.where(mask, torch.tensor([0.5, 0.0]), self.message)
        return TensorDict({"message": self.message}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        level = self.message[:, :1]
        inflow = 0.2 * (tensordict["action"] - 0.9 * torch.rand_like(level))
        self.message = torch.cat([(level + inflow).clamp(min=0.0), inflow], -1)
        return TensorDict({"message": self.message, **judge(self.message)}, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(seed or 0)


def judge(message: Tensor) -> dict[str, Tensor]:
    """Reward and end [*, 1], which follow from a message [*, 2]: the level and the latest
    inflow."""
    level, inflow = message.split(1, -1)
    overflowed = level > 1
    return {
        "reward": 1 - 2 * (level - 0.5).abs() - inflow.abs(),
        "terminated": overflowed,
        "done": overflowed,
    }


class ControlRoom(Transform):
    """Replaces rewards and ends by those that follow from the message that the room holds."""

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.update(judge(next_tensordict["received"]))


def recompute(steps: TensorDictBase, messages: Tensor) -> dict[NestedKey, Tensor]:
    """Rewards and ends after steps [T, B], had the room held these messages [T, B, 2]."""
    result = judge(messages)
    result["truncated"] = steps["next", "step_count"] >= MAX_STEPS
    result["done"] = result["terminated"] | result["truncated"]
    return {("next", key): value for key, value in result.items()}


def main() -> tuple[TensorDictBase, Tensor]:
    """Collect, store and report; returns all stored steps, and the rewards as collected, both
    [T, B]."""
    torch.manual_seed(0)
    delay = ObservationDelay(
        Uniform(3, 7), ["message"], ["received"], age_key="age", delay_key="delay"
    )
    env = TransformedEnv(Tanks(WORLDS), Compose(delay, ControlRoom(), StepCounter(MAX_STEPS)))
    storage = BackupdateStorage(
        max_size=BATCHES * BATCH_STEPS * WORLDS,
        recompute=recompute,
        longest=7,  # steps
        message_key="message",
        received_key="received",
        delay_key="delay",
        age_key="age",
        hindsight_key="hindsight",
    )
    buffer = ReplayBuffer(storage=storage, batch_size=256)
    frames = BATCH_STEPS * WORLDS
    collected = []
    for batch in Collector(env, frames_per_batch=frames, total_frames=BATCHES * frames):
        collected.append(batch["next", "reward"].transpose(0, 1).clone())
        buffer.extend(batch)  # stores the steps, and corrects those that late messages concern
        sample = buffer.sample()
        sample = sample[sample["valid"].squeeze(-1)]  # here a learner would learn from the sample
    steps = storage[storage.latest()]
    report(steps, torch.cat(collected))
    return steps, torch.cat(collected)


def report(steps: TensorDictBase, collected: Tensor) -> None:
    """Print how far rewards and messages are from the truth, before and after back-updating."""
    after = steps["next"]
    truth = judge(after["message"])["reward"]
    for name, estimate, true in (
        ("reward as collected", collected, truth),
        ("reward after back-updating", after["reward"], truth),
        ("message that the room held", after["received"], after["message"]),
        ("message in hindsight", after["hindsight"], after["message"]),
    ):
        print(f"mean error of the {name}: {(estimate - true).abs().mean():.4f}")
    print(
        f"steps whose reward a late message has changed: {steps['backupdated'].float().mean():.1%}"
    )
    print(
        "steps after the end of an episode, not to learn from: "
        f"{(~steps['valid']).float().mean():.1%}"
    )


if __name__ == "__main__":
    main()
