"""A policy that draws its actions at random, the baseline for every result."""

from tensordict.nn import TensorDictModule
from torch import Tensor, multinomial
from torchrl.envs import EnvBase

from damian import keys


def random_policy(env: EnvBase) -> TensorDictModule:
    """Build a policy that draws uniformly from the legal actions."""
    spec = env.full_action_spec_unbatched[keys.ACTION]
    masked = keys.ACTION_MASK in env.observation_spec.keys(True, True)

    def sample(entry: Tensor) -> Tensor:
        if masked:
            return multinomial(entry.flatten(0, -2).float(), 1).view(entry.shape[:-1])
        return spec.rand(entry.shape[:1])

    in_key = keys.ACTION_MASK if masked else keys.OBSERVATION
    return TensorDictModule(sample, in_keys=[in_key], out_keys=[keys.ACTION])
