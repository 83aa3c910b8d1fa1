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
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor

import damian
from damian import keys
from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError
from damian.envs.delayed_env import DelayedEnv
from damian.runs.run_folder import RESULTS
from damian.server.features import feature_of
from damian.settings import ActionConfig, ScenarioConfig
from damian.world.landing import action_table

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

    def __init__(self, actor: ProbabilisticActor) -> None:
        super().__init__()
        *layers, _ = actor.module
        self.layers, self.in_keys = nn.ModuleList(layers), [*actor.in_keys]
        self.recurrent = keys.HIDDEN in self.in_keys
        self.discrete = keys.LOGITS in actor.out_keys
        self.inputs = [str(keys.last_part(key)) for key in self.in_keys]
        parameters = ["probability"] if self.discrete else ["loc", "scale"]
        self.outputs = ["action", *parameters, *["hidden"] * self.recurrent]

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Inputs [B, N, *] to outputs [B, N, *]; the action is the most likely one."""
        entries = TensorDict({}, batch_size=[])
        for key, value in zip(self.in_keys, inputs, strict=True):
            entries.set(key, value)
        for layer in self.layers:
            entries = layer(entries)
        hidden = (entries[keys.HIDDEN],) if self.recurrent else ()
        if not self.discrete:
            loc, scale = entries[keys.LOC], entries[keys.SCALE]
            return ((loc.tanh() + 1) / 2, loc, scale, *hidden)
        logits = entries[keys.LOGITS]
        if keys.ACTION_MASK in self.in_keys:
            logits = logits.masked_fill(~entries[keys.ACTION_MASK], -1e8)
        return (logits.argmax(-1), logits.softmax(-1), *hidden)


def export(run: Path, trust: bool = False) -> Path:
    """Export the policy of a run folder into its subfolder ``export``; returns that folder."""
    safetensors, _ = _needed("safetensors.torch"), _needed("onnxscript")
    actor, env = load(run, worlds=2, trust=trust)
    policy, target = ExportedPolicy(actor).eval(), run_folder(run) / EXPORT
    examples = tuple(env.reset()[key] for key in policy.in_keys)
    sizes = {0: torch.export.Dim("worlds", min=1)}
    if any_number_of_uavs(stored_config(run_folder(run), "checkpoint")):
        sizes[1] = torch.export.Dim("uavs", min=1)
    target.mkdir(exist_ok=True)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # torch's own
        program = torch.export.export(policy, examples, dynamic_shapes=((sizes,) * len(examples),))
        torch.export.save(program, target / "policy.pt2")
    safetensors.save_file(
        {name: weight.contiguous() for name, weight in policy.state_dict().items()},
        target / "policy.safetensors",
    )
    # ONNX does not let an output have the name of an input.
    outputs = [f"next_{name}" if name == "hidden" else name for name in policy.outputs]
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it misses torchvision, which nobody needs
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        torch.onnx.export(
            program,
            (),
            target / "policy.onnx",
            input_names=policy.inputs,
            output_names=outputs,
            external_data=False,
            verbose=False,
        )
    described = describe(run, policy, env, dict(zip(policy.inputs, examples, strict=True)), 1 in sizes)
    write_atomically(target / DESCRIPTION, json.dumps(described, indent=2) + "\n")
    return target


def _needed(module: str) -> Any:
    """A module that not every installation has."""
    try:
        return import_module(module)
    except ImportError:
        raise InputError(f"export needs {module.partition('.')[0]}: {NEED}") from None


def describe(
    run: Path, policy: ExportedPolicy, env: DelayedEnv, examples: Mapping[str, Tensor], any_number: bool
) -> dict[str, Any]:
    """What goes in and what comes out, for people and programs without damian."""
    scenario = env.uav_env.scenario
    shapes = {name: [*example.shape[2:]] for name, example in examples.items()}
    inputs: dict[str, Any] = {
        name: {"shape": ["worlds", "uavs", *shape], "dtype": str(examples[name].dtype).removeprefix("torch.")}
        for name, shape in shapes.items()
    }
    inputs["observation"]["columns"] = columns(scenario, shapes["observation"][0])
    if "action_mask" in inputs:
        inputs["action_mask"]["meaning"] = "which actions are allowed now"
    if policy.recurrent:
        inputs["hidden"]["meaning"] = (
            "the output hidden of the step before; zeros at the beginning of an episode"
        )
    outputs = {
        "action": "the most likely action: an index of actions, or distance and heading in [0, 1]",
        "probability": "probability of each action, to draw from",
        "loc": "before tanh, of the normal distribution to draw from",
        "scale": "before tanh, its standard deviation",
        "hidden": "the input hidden of the next step",
    }
    return {
        "damian": damian.__version__,
        "run": str(run),
        "uavs": "any number" if any_number else scenario.agents,
        "step_s": scenario.clock.dt,
        "inputs": inputs,
        "outputs": {name: outputs[name] for name in policy.outputs},
        "actions": actions(scenario.actions),
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


def actions(config: ActionConfig) -> dict[str, Any]:
    """What an action is: where it leads from the place where the UAV stands."""
    units = {"distance": "m", "heading": "degrees, clockwise from north"}
    if config.kind != "discrete":
        return {"units": units, "distance": [0.0, max(config.distances)], "heading": [0.0, 360.0]}
    table = [
        [distance, math.degrees(heading)]
        for distance, heading in action_table(config, torch.float64).tolist()
    ]
    return {"units": units, "columns": ["distance", "heading"], "table": table}


def run() -> None:
    """Export the policy of the run folder that the command line names."""
    words = [word.removeprefix("checkpoint=") for word in sys.argv[1:] if word != "trust=true"]
    if len(words) != 1:
        raise InputError(
            "damian export RUN: give the run folder, and trust=true if it names code of your own"
        )
    folder = Path(words[0])
    target = export(folder, trust=len(words) < len(sys.argv[1:]))
    if not (folder / RESULTS).exists() and not folder.is_file():
        print(f"{folder}: the training has not finished; its latest checkpoint is exported")
    print(f"results: {target}")
