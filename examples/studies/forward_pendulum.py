"""Fly a late observation forward: a copy of the environment steps from it to now, with the actions
since.

    python examples/studies/forward_pendulum.py

The model is Gymnasium's Pendulum itself, so that nothing is lost by a delay of observations.
"""

import math

import gymnasium
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import Compose, GymEnv, Transform, TransformedEnv

from damian import ObservationDelay, Uniform, set_seed


class FlownForward(Transform):
    """Writes the observation of Pendulum as it is now, ``predicted``, by a model that starts from
    the one of ``age`` steps ago and takes the actions since.

    Args:
        longest: longest delay [steps].
    """

    def __init__(self, longest: int) -> None:
        super().__init__(["received"], ["predicted"])
        self.longest = longest
        self.actions: list[Tensor] = []
        """The latest actions, the latest one first, [*, 1] each."""
        self.model = gymnasium.make("Pendulum-v1").unwrapped

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.actions = [tensordict["action"].clone(), *self.actions[: self.longest - 1]]
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        ages = next_tensordict["age"].flatten().long().tolist()
        late = next_tensordict["received"]
        predicted = late.clone()
        rows = zip(predicted.view(-1, 3), late.view(-1, 3), ages, strict=True)
        for world, (row, observed, age) in enumerate(rows):
            cos, sin, speed = observed.double().tolist()
            self.model.state = (math.atan2(sin, cos), speed)
            for action in reversed(self.actions[:age]):
                told, *_ = self.model.step(action.view(-1, 1)[world].numpy())
                row.copy_(torch.as_tensor(told))
        return next_tensordict.set("predicted", predicted)

    def _reset(self, tensordict: TensorDictBase, reset: TensorDictBase) -> TensorDictBase:
        self.actions = []
        return reset.set("predicted", reset["received"].clone())

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec["predicted"] = observation_spec["received"].clone()
        return observation_spec


def main() -> None:
    """Compare what is predicted with what is, in an episode with random actions."""
    late = ObservationDelay(Uniform(1, 6), ["observation"], ["received"])
    env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(late, FlownForward(6)))
    set_seed(env, 0)
    after = env.rollout(200)["next"]
    for name in ("received", "predicted"):
        error = (after[name] - after["observation"]).abs().amax().item()
        print(f"{name}: largest error {error:.2g}, mean age {after['age'].mean():.1f} steps")


if __name__ == "__main__":
    main()
