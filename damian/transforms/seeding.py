"""Lets ``env.set_seed`` reach the transforms, which TorchRL's ``TransformedEnv`` does not seed.

Importing this module extends ``TransformedEnv.set_seed`` for the whole process, in workers too: it then also
seeds the transforms of damian that the environment contains. All else stays as it is.
"""

from functools import wraps

from torchrl.envs import EnvBase, Transform, TransformedEnv

from damian.transforms.order import leaf_transforms


def all_transforms(env: EnvBase | None) -> list[Transform]:
    """All transforms of an environment and of those within it, in the order in which outputs pass them."""
    if not isinstance(env, TransformedEnv):
        return []
    return [*all_transforms(env.base_env), *leaf_transforms(env.transform)]


def stream_name(transform: Transform) -> str:
    """What tells the random streams of a transform from those of all others in its environment.

    It is made of the transform's class and keys and, if several have both in common, of its place among them,
    so that adding another transform changes no draws.
    """
    name = _class_and_keys(transform)
    others = all_transforms(transform.container)
    alike = [other for other in others if type(other) is type(transform) and _class_and_keys(other) == name]
    return f"{name} {next((i for i, other in enumerate(alike) if other is transform), 0)}"


def _class_and_keys(transform: Transform) -> str:
    return f"{type(transform).__name__} {transform.in_keys} {transform.in_keys_inv}"


_set_seed_of_torchrl = TransformedEnv.set_seed


@wraps(_set_seed_of_torchrl)
def _set_seed(self: TransformedEnv, seed: int | None = None, static_seed: bool = False) -> int | None:
    for transform in leaf_transforms(self.transform):
        if hasattr(transform, "seed_worlds"):
            transform.set_seed(seed)
    return _set_seed_of_torchrl(self, seed, static_seed)


TransformedEnv.set_seed = _set_seed  # type: ignore[method-assign]
