"""A policy as programs of torch and ONNX, which run without damian and TorchRL."""

import copy
import logging
import warnings
from contextlib import redirect_stderr
from io import StringIO
from typing import Any

import torch
from tensordict import NestedKey, TensorDict
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.data import Categorical, TensorSpec
from torchrl.modules import ProbabilisticActor

from damian import keys
from damian.common import checks
from damian.common.errors import naming_errors
from damian.envs.delayed_env import DelayedEnv


class ExportedPolicy(nn.Module):
    """A policy as a function of tensors, which are called ``inputs`` and ``outputs``, in this
    order."""

    def __init__(self, actor: ProbabilisticActor, spec: TensorSpec) -> None:
        super().__init__()
        *layers, last = copy.deepcopy(actor.module)
        self.last: Any = last
        self.last.return_log_prob = False
        self.layers = nn.ModuleList(layers)
        self.in_keys = [*actor.in_keys]
        self.recurrent = keys.HIDDEN in self.in_keys
        self.discrete = isinstance(spec, Categorical) and hasattr(
            self.last.distribution_class, "probs"
        )
        self.parameter_keys: list[NestedKey] = [
            key for key in self.last.in_keys if key not in self.in_keys
        ]
        names = ["probability"] if self.discrete else map(keys.last_part, self.parameter_keys)
        self.inputs = [*map(keys.last_part, self.in_keys)]
        self.outputs = ["action", *names, *["hidden"] * self.recurrent]

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Inputs [B, N, *] to outputs [B, N, *]; the action is the actor's own without chance."""
        entries = TensorDict({}, batch_size=[])
        for key, value in zip(self.in_keys, inputs, strict=True):
            entries.set(key, value)
        for layer in self.layers:
            entries = layer(entries)
        checked = Distribution._validate_args
        Distribution.set_default_validate_args(False)  # no program can contain checks of parameters
        try:
            action = self.last(entries)[keys.ACTION]
            shown = [self.last.get_dist(entries).probs] if self.discrete else []
        finally:
            Distribution.set_default_validate_args(checked)
        shown = shown or [entries[key] for key in self.parameter_keys]
        return action, *shown, *([entries[keys.HIDDEN]] if self.recurrent else [])


def exported(
    actor: ProbabilisticActor, env: DelayedEnv, any_number: bool, learner: str
) -> tuple[ExportedPolicy, torch.export.ExportedProgram, Any]:
    """The policy, and it as a program of torch and of ONNX, for any number of worlds and, if so, of
    UAVs.

    Raises:
        InputError: no program gives the actions of the actor.
    """
    key = f"learner: {learner} cannot be exported"
    policy = ExportedPolicy(actor, env.full_action_spec_unbatched[keys.ACTION]).eval()
    steps = env.rollout(16, break_when_any_done=False).flatten()
    missing = [str(each) for each in policy.in_keys if each not in steps.keys(True)]
    checks.require(
        not missing, key, ", ".join(missing), "is what its actor reads, and not in the environment"
    )
    inputs = [steps[each] for each in policy.in_keys]
    examples = tuple(each[:2].clone() for each in inputs)
    sizes = {0: torch.export.Dim("worlds", min=1)}
    if any_number:
        sizes[1] = torch.export.Dim("uavs", min=1)
        if inputs[0].shape[1] == 1:  # torch would take a single UAV for a constant
            examples = tuple(each.repeat_interleave(2, 1) for each in examples)
    # ONNX does not let an output have the name of an input.
    outputs = [f"next_{name}" if name == "hidden" else name for name in policy.outputs]
    logging.getLogger("torch").setLevel(logging.ERROR)  # it misses torchvision, which nobody needs
    said = redirect_stderr(StringIO())  # torch prints the whole program if it refuses it
    with torch.no_grad(), warnings.catch_warnings(), naming_errors(key), said:
        warnings.simplefilter("ignore", FutureWarning)  # torch's own
        live = actor(steps)[keys.ACTION]
        name = policy.last.distribution_class.__name__
        checks.require(
            policy(*inputs)[0].allclose(live),
            key,
            name,
            "needs a property deterministic_sample: without it the action is drawn by chance",
        )
        program = torch.export.export(policy, examples, dynamic_shapes=((sizes,) * len(examples),))
        found = program.module()(*inputs)[0]
        checks.require(
            found.allclose(live), key, "the actor's actions", "are not those of the program"
        )
        onnx = torch.onnx.export(
            program, (), input_names=policy.inputs, output_names=outputs, verbose=False
        )
    return policy, program, onnx
