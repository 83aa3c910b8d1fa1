"""Export a trained policy, so that it can fly without damian: on a companion computer, or in another program.

damian export runs/FOLDER    # fills runs/FOLDER/export

``policy.pt2`` is a program of ``torch.export``, ``policy.onnx`` the same for ONNX runtimes, and
``policy.safetensors`` its weights; ``policy.json`` says what goes in and what comes out (docs/runs.md).
"""

import json
import logging
import math
import sys
import warnings
from contextlib import redirect_stderr
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from tensordict import NestedKey, TensorDict
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torchrl.data import Bounded, Categorical, TensorSpec
from torchrl.modules import ProbabilisticActor

import damian
from damian import keys
from damian.common import checks
from damian.common.atomic_files import write_atomically, writing
from damian.common.errors import InputError, naming_errors
from damian.envs.config import ScenarioConfig
from damian.envs.delayed_env import DelayedEnv
from damian.runs.run_folder import RESULTS
from damian.server.features import feature_of
from damian.world.config import ActionConfig
from damian.world.landing import action_table

from . import cli
from .evaluate import load
from .shared.runs import any_number_of_uavs, run_folder, stored_config

EXPORT, DESCRIPTION = "export", "policy.json"
NEED = "pip install 'damian[export]'"
UNFILTERED = (
    "the columns of the belief are those of a Bayes filter, which is not exported: "
    "compute them with damian.server.belief, or train a policy without a belief"
)


class ExportedPolicy(nn.Module):
    """A policy as a function of tensors, which are called ``inputs`` and ``outputs``, in this order."""

    def __init__(self, actor: ProbabilisticActor, spec: TensorSpec) -> None:
        super().__init__()
        *layers, last = actor.module
        self.last: Any = last
        self.last.return_log_prob = False
        self.layers, self.in_keys = nn.ModuleList(layers), [*actor.in_keys]
        self.recurrent = keys.HIDDEN in self.in_keys
        self.discrete = isinstance(spec, Categorical) and hasattr(self.last.distribution_class, "probs")
        self.parameter_keys: list[NestedKey] = [key for key in self.last.in_keys if key not in self.in_keys]
        names = ["probability"] if self.discrete else map(_name, self.parameter_keys)
        self.inputs = [_name(key) for key in self.in_keys]
        self.outputs = ["action", *names, *["hidden"] * self.recurrent]
        self.answers: list[Any] = []

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Inputs [B, N, *] to outputs [B, N, *]; the action is the actor's own without chance."""
        entries = TensorDict({}, batch_size=[])
        for key, value in zip(self.in_keys, inputs, strict=True):
            entries.set(key, value)
        for layer in self.layers:
            entries = layer(entries)
        # A tensor that is traced makes a list of its items one by one, so that nobody would be asked for it.
        with patch.object(type(inputs[0]), "tolist", Tensor.tolist), _Answers(self.answers):
            action = self.last(entries)[keys.ACTION]
            shown = [entries[key] for key in self.parameter_keys]
            if self.discrete:
                shown = [self.last.get_dist(entries).probs]
        return action, *shown, *([entries[keys.HIDDEN]] if self.recurrent else [])


class _Answers(TorchFunctionMode):
    """Keeps what Python asks about values in tensors at first, and then always answers the same.

    Distributions check their parameters in this way, which no program of ``torch.export`` can contain.
    """

    ASK = (Tensor.__bool__, Tensor.item, Tensor.tolist, torch.equal)

    def __init__(self, answers: list[Any]) -> None:
        super().__init__()
        self.kept, self.known = answers, iter([*answers]) if answers else None

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if func not in self.ASK:
            return func(*args, **kwargs or {})
        if self.known is not None:
            return next(self.known)
        self.kept.append(func(*args, **kwargs or {}))
        return self.kept[-1]


def export(run: Path, trust: bool = False) -> Path:
    """Export the policy of a run folder into its subfolder ``export``; returns that folder."""
    safetensors, _ = _needed("safetensors.torch"), _needed("onnxscript")
    actor, env = load(run, worlds=2, deterministic=True, trust=trust)
    config, target = stored_config(run_folder(run), "checkpoint"), run_folder(run) / EXPORT
    any_number = any_number_of_uavs(config)
    policy, program, onnx = exported(actor, env, any_number, config.learner.name)
    described = describe(run, policy, env, any_number)
    with writing(target):
        target.mkdir(exist_ok=True)
        torch.export.save(program, target / "policy.pt2")
        weights = {name: weight.contiguous() for name, weight in policy.state_dict().items()}
        safetensors.save_file(weights, target / "policy.safetensors")
        onnx.save(target / "policy.onnx", external_data=False)
    write_atomically(target / DESCRIPTION, json.dumps(described, indent=2, default=_plain) + "\n")
    return target


def exported(
    actor: ProbabilisticActor, env: DelayedEnv, any_number: bool, learner: str
) -> tuple[ExportedPolicy, torch.export.ExportedProgram, Any]:
    """The policy, and it as a program of torch and of ONNX, for any number of worlds and, if so, of UAVs.

    Raises:
        InputError: no program gives the actions of the actor.
    """
    key = f"learner: {learner} cannot be exported"
    policy = ExportedPolicy(actor, env.full_action_spec_unbatched[keys.ACTION]).eval()
    steps = env.rollout(16, break_when_any_done=False).flatten()
    missing = [_name(each) for each in policy.in_keys if each not in steps.keys(True)]
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
        live, name = actor(steps)[keys.ACTION], policy.last.distribution_class.__name__
        should = "needs a property deterministic_sample: without it the action is drawn by chance"
        checks.require(policy(*inputs)[0].equal(live), key, name, should)
        program = torch.export.export(policy, examples, dynamic_shapes=((sizes,) * len(examples),))
        found, should = program.module()(*inputs)[0], "are not those of the program"
        checks.require(found.allclose(live), key, "the actor's actions", should)
        onnx = torch.onnx.export(program, (), input_names=policy.inputs, output_names=outputs, verbose=False)
    return policy, program, onnx


def _name(key: NestedKey) -> str:
    return str(keys.last_part(key))


def _plain(value: Any) -> Any:
    """A value for JSON."""
    return value.tolist() if isinstance(value, Tensor) else str(value)


def _needed(module: str) -> Any:
    """A module that not every installation has."""
    try:
        return import_module(module)
    except ImportError:
        raise InputError(f"export needs {module.partition('.')[0]}: {NEED}") from None


def describe(run: Path, policy: ExportedPolicy, env: DelayedEnv, any_number: bool) -> dict[str, Any]:
    """What goes in and what comes out, for people and programs without damian."""
    scenario, inputs = env.uav_env.scenario, {}
    for name, key in zip(policy.inputs, policy.in_keys, strict=True):
        spec = env.full_observation_spec[key]
        shape = ["worlds", "uavs", *spec.shape[2:]]
        inputs[name] = {"shape": shape, "dtype": str(spec.dtype).removeprefix("torch.")}
        if key == keys.OBSERVATION:
            inputs[name]["columns"] = columns(scenario, spec.shape[-1])
    if "action_mask" in inputs:
        inputs["action_mask"]["meaning"] = "which actions are allowed now"
    if policy.recurrent:
        inputs["hidden"]["meaning"] = (
            "the output hidden of the step before; zeros at the beginning of an episode"
        )
    outputs = dict.fromkeys(policy.outputs, "parameter of the distribution to draw from") | {
        "action": "the action without chance, as described under actions",
        "probability": "probability of each action, to draw from",
        "hidden": "the input hidden of the next step",
    }
    drawn_from = policy.last.distribution_class
    return {
        "damian": damian.__version__,
        "run": str(run),
        "uavs": "any number" if any_number else scenario.agents,
        "step_s": scenario.clock.dt,
        "inputs": inputs,
        "outputs": {name: outputs[name] for name in policy.outputs},
        "distribution": {"class": drawn_from.__name__, **policy.last.distribution_kwargs},
        "actions": actions(scenario.actions, env.full_action_spec_unbatched[keys.ACTION]),
        **({"limit": UNFILTERED} if scenario.observation.belief else {}),
    }


def columns(scenario: ScenarioConfig, n_columns: int) -> list[dict[str, Any]]:
    """Describe the columns of an observation, in order; the server has scaled them already."""
    widths, found = {"agent_distances": scenario.agents - 1, "belief_gain": scenario.actions.n_actions}, []
    for name in scenario.observation.actor:
        feature = feature_of(name)
        width = widths.get(name, feature.width)
        meaning = " ".join((feature.compute.__doc__ or "").split())
        found.append(
            {"feature": name, "columns": width, "low": feature.low, "high": feature.high, "meaning": meaning}
        )
    left = n_columns - sum(each["columns"] or 0 for each in found)
    if left and scenario.delay.history:
        meaning = f"the latest {scenario.delay.history} actions of the UAV itself, scaled, the oldest first"
        found.append(
            {"feature": "action history", "columns": left, "low": 0.0, "high": 1.0, "meaning": meaning}
        )
    return found


def actions(config: ActionConfig, spec: TensorSpec) -> dict[str, Any]:
    """What an action is: where it leads from the place where the UAV stands."""
    units = {"distance": "m", "heading": "degrees, clockwise from north"}
    if isinstance(spec, Bounded):
        low, high = (bound[0].tolist() for bound in (spec.low, spec.high))
        meaning = "the bounds low and high of an action stand for these; a value beyond counts as the bound"
        ends = {"distance": [0.0, max(config.distances)], "heading": [0.0, 360.0]}
        return {"units": units, "columns": [*ends], "low": low, "high": high, **ends, "meaning": meaning}
    table = [
        [distance, math.degrees(heading)]
        for distance, heading in action_table(config, torch.float64).tolist()
    ]
    return {"meaning": "index of a row", "units": units, "columns": ["distance", "heading"], "table": table}


def run() -> None:
    """Export the policy of the run folder that the command line names."""
    words = [word.removeprefix("checkpoint=") for word in sys.argv[1:] if word != "trust=true"]
    with cli.one_line_errors():
        if len(words) != 1:
            raise InputError(
                "damian export RUN: give the run folder, and trust=true if it names code of your own"
            )
        folder = Path(words[0])
        target = export(folder, trust=len(words) < len(sys.argv[1:]))
    if not (folder / RESULTS).exists() and not folder.is_file():
        print(f"{folder}: the training has not finished; its latest checkpoint is exported")
    print(f"results: {target}")
