"""A policy that chooses among the legal actions by chance: what every result is compared with."""

from tensordict.nn import TensorDictModule
from torch import Tensor, multinomial
from torchrl.envs import EnvBase


def random_policy(env: EnvBase) -> TensorDictModule:
    """Uniform over the legal actions; writes ``("agents", "action")``."""
    spec = env.full_action_spec_unbatched["agents", "action"]
    masked = ("agents", "action_mask") in env.observation_spec.keys(True, True)

    def sample(seen: Tensor) -> Tensor:
        if masked:
            return multinomial(seen.flatten(0, -2).float(), 1).view(seen.shape[:-1])
        return spec.rand(seen.shape[:1])

    key = "action_mask" if masked else "observation"
    return TensorDictModule(sample, in_keys=[("agents", key)], out_keys=[("agents", "action")])
