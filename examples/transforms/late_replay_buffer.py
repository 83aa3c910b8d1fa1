"""A replay buffer or a dataset of undelayed steps becomes a delayed one: a function to copy, and
its use.

    python examples/transforms/late_replay_buffer.py
"""

from collections.abc import Sequence
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, LazyTensorStorage, ReplayBuffer, TensorSpec
from torchrl.envs import Compose, EnvBase, GymEnv, Transform, TransformedEnv
from torchrl.envs.utils import make_composite_from_td

from damian import ObservationDelay, RewardDelay, Uniform
from damian.common.errors import InputError
from damian.keys import ENDS, last_part
from damian.transforms.action import ActionTransform
from damian.transforms.base import leaf_transforms

_TRAJECTORY = ("collector", "traj_ids")
"""Key under which TorchRL's collectors store the number of each step's episode."""


@torch.no_grad()
def delay_trajectories(
    data: TensorDictBase, transform: Transform, *, action_spec: TensorSpec | None = None
) -> TensorDictBase:
    """Apply transforms to stored steps, as if the environment had had them when the steps were
    collected.

    The result equals, bit for bit, what the same transforms with the same seeds give in the
    environment, if the actions are the same. A row of ``data`` is a world, and may contain several
    episodes. A step begins an episode if it is the first of its row, if the step before it is done,
    if the number ``("collector", "traj_ids")`` says so, or if an entry differs from the one under
    ``"next"`` one step before. The message of such a step has no delay. Rewards in transit where
    the data ends or is cut are not paid.

    Args:
        data: steps as TorchRL stores them, [T] or [*, T]; TensorDicts of agents have batch size
            [*, T, N].
        transform: a transform or a ``Compose``; it is copied. ``InputError`` if it changes what
            happened, as ``ActionDelay`` does.
        action_spec: ``env.full_action_spec``, which only ``ActionHistory`` needs, for the range of
            the actions.
    """
    leaves = leaf_transforms(transform)
    for leaf in leaves:
        if leaf.out_keys_inv or any(last_part(key) in ENDS for key in leaf.out_keys):
            raise InputError(
                f"transform: {type(leaf).__name__} changes which actions are executed or when "
                "episodes end, "
                "but stored steps show what followed: use it where the steps are collected"
            )
    playback = _Playback(data, _read_action_specs(data, leaves, action_spec))
    env = TransformedEnv(playback, transform.clone())
    starts = _find_starts(data)
    now = env.reset()
    steps = []
    for time, any_starts in enumerate(starts.reshape(-1, starts.shape[-1]).any(0).tolist()):
        if time and any_starts:
            now = env.reset(now.set("_reset", starts[..., time].unsqueeze(-1)))
        steps.append(env.step(playback.add_inputs(now)))
        now = env.step_mdp(steps[-1])
    played = cast(TensorDictBase, torch.stack(steps, starts.dim() - 1)).refine_names(..., "time")
    if not played["next", "done"].equal(data["next", "done"]):
        raise InputError("transform: it ends episodes where the stored steps go on")
    return played


class _Playback(EnvBase):
    """An environment that outputs stored steps [*, T] in their order, whatever the actions are."""

    def __init__(self, data: TensorDictBase, action_spec: Composite) -> None:
        super().__init__(device=data.device, batch_size=data.batch_size[:-1])
        self._steps = data.unbind(-1)
        self._time = 0
        first = self._steps[0]
        after = self._steps[0]["next"]
        self._outputs = _output_keys(first)
        ends = [key for key in _leaves(after) if last_part(key) in ENDS]
        self._inputs = [
            key for key in _leaves(first.exclude("next")) if key not in [*self._outputs, *ends]
        ]
        rewards = [key for key in _leaves(after) if key not in [*self._outputs, *ends]]
        self.observation_spec = _specs_of(first, self._outputs)
        self.reward_spec = _specs_of(after, rewards)
        self.done_spec = _specs_of(after, ends)
        self.action_spec = action_spec

    def add_inputs(self, outputs: TensorDictBase) -> TensorDictBase:
        """The outputs before a step, and what is stored beside them: actions, and what the policy
        wrote."""
        return outputs.update(self._steps[self._time].select(*self._inputs))

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        return self._steps[self._time].select(*self._outputs)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._time += 1
        return self._steps[self._time - 1]["next"].clone(False)

    def _set_seed(self, seed: int | None) -> None:
        """Stored steps have no randomness."""


# The stored steps.


def _find_starts(data: TensorDictBase) -> Tensor:
    """Mask of the first steps of episodes, [*, T] bool."""
    before = cast(TensorDictBase, data[..., :-1])
    after = cast(TensorDictBase, data[..., 1:])
    starts = _any(before, before.get(("next", "done")))
    if _TRAJECTORY in _leaves(data):
        starts = starts | _any(after, after.get(_TRAJECTORY) != before.get(_TRAJECTORY))
    for key in _output_keys(data):
        new = after.get(key)
        expected = before.get("next").get(key)
        starts = starts | _any(after, ~torch.isclose(new, expected, rtol=0, atol=0, equal_nan=True))
    first = torch.ones(*data.batch_size[:-1], 1, dtype=torch.bool, device=starts.device)
    return torch.cat([first, starts], -1)


def _any(data: TensorDictBase, flag: Tensor) -> Tensor:
    """Is a flag [*, T, ...] true anywhere in a step, [*, T]."""
    return flag.reshape(*data.batch_size, -1).bool().any(-1)


def _output_keys(data: TensorDictBase) -> list[NestedKey]:
    """Keys of the entries, ends excepted, that the data has both before and after each step."""
    after = _leaves(data["next"])
    return [
        key for key in _leaves(data.exclude("next")) if key in after and last_part(key) not in ENDS
    ]


def _leaves(tensordict: TensorDictBase) -> list[NestedKey]:
    return list(tensordict.keys(True, True))


def _read_action_specs(
    data: TensorDictBase, transforms: Sequence[Transform], action_spec: TensorSpec | None
) -> Composite:
    """Specs of the actions of one step of the data, from those of an environment of any number of
    worlds."""
    step = data.exclude("next").unbind(-1)[0]
    n_batch = data.dim() - 1
    keys = [
        transform.action_key for transform in transforms if isinstance(transform, ActionTransform)
    ]
    specs = _specs_of(step, [key for key in _leaves(step) if key in keys])
    for key in keys:
        if action_spec is None:
            raise InputError(
                f"action_spec: it is needed for the range of {key}: pass env.full_action_spec"
            )
        spec: Any = action_spec[key] if isinstance(action_spec, Composite) else action_spec
        action = step.get(key)
        n_worlds = len(spec.shape) - len(
            action.shape[n_batch:]
        )  # leading dimensions of the spec alone
        specs[key] = (
            spec[(0,) * n_worlds].expand(action.shape) if n_worlds else spec.expand(action.shape)
        )
    return specs


def _specs_of(tensordict: TensorDictBase, keys: Sequence[NestedKey]) -> Composite:
    """Specs without bounds of the entries of these keys."""
    specs = make_composite_from_td(tensordict.select(*keys), unsqueeze_null_shapes=False)
    return specs.to(tensordict.device) if tensordict.device else specs


if __name__ == "__main__":
    buffer = ReplayBuffer(storage=LazyTensorStorage(1000), batch_size=32)
    buffer.extend(
        GymEnv("CartPole-v1").rollout(500, break_when_any_done=False)
    )  # many episodes in a row

    delays = Compose(ObservationDelay(Uniform(1, 4), seed=0), RewardDelay(2, seed=1))
    steps = delay_trajectories(buffer[:], delays)
    buffer.empty()
    buffer.extend(steps)
    print(f"mean age of an observation: {buffer.sample()['age'].mean():.1f} steps")
