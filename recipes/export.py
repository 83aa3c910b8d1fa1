"""Export a trained policy, so that it can fly without damian: on a companion computer, or in
another program.

damian export runs/FOLDER    # fills runs/FOLDER/export

``policy.pt2`` is a program of ``torch.export``, ``policy.onnx`` the same for ONNX runtimes;
``policy.json`` says what goes in and what comes out (docs/runs.md).
"""

import json
import math
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor
from torchrl.data import Bounded, TensorSpec

import damian
from damian import keys
from damian.common.atomic_files import make_folder, not_linked, write_atomically, writing
from damian.common.errors import InputError
from damian.envs.delayed_env import DelayedEnv
from damian.interop.exported_policy import ExportedPolicy, exported
from damian.runs.run_folder import EXPORT, RESULTS
from damian.server.layout import Layout
from damian.world.config import ActionConfig
from damian.world.landing import action_table

from . import cli
from .evaluate import load
from .shared.runs import any_number_of_uavs, run_folder, stored_config

UNFILTERED = (
    "the columns of the belief are those of a Bayes filter, which is not exported: "
    "compute them with damian.server.belief, or train a policy without a belief"
)


def export(run: Path, trust: bool) -> Path:
    """Export the policy of a run folder into its subfolder ``export``; returns that folder."""
    try:
        import_module("onnxscript")
    except ImportError as error:
        raise InputError(f"export needs {error.name}: pip install 'damian[export]'") from None
    actor, env = load(run, num_worlds=2, deterministic=True, trust=trust)
    config = stored_config(run_folder(run), "checkpoint")
    shipped = str(run).startswith("damian:")
    named = Path("runs") if shipped else run_folder(run)
    target = named / run_folder(run).name / EXPORT if shipped else named / EXPORT
    any_number = any_number_of_uavs(config)
    policy, program, onnx = exported(actor, env, any_number, config.learner.name)
    described = describe(run, policy, env, any_number)
    with writing(target):
        make_folder(target, below=named)
        torch.export.save(program, not_linked(target / "policy.pt2"))
        onnx.save(not_linked(target / "policy.onnx"), external_data=False)
    text = json.dumps(
        described, indent=2, default=lambda x: x.tolist() if isinstance(x, Tensor) else str(x)
    )
    write_atomically(target / "policy.json", text + "\n")
    return target


def describe(
    run: Path, policy: ExportedPolicy, env: DelayedEnv, any_number: bool
) -> dict[str, Any]:
    """What goes in and what comes out, for people and programs without damian."""
    scenario = env.uav_env.scenario
    inputs = {}
    for name, key in zip(policy.inputs, policy.in_keys, strict=True):
        spec = env.full_observation_spec[key]
        shape = ["worlds", "uavs", *spec.shape[2:]]
        inputs[name] = {"shape": shape, "dtype": str(spec.dtype).removeprefix("torch.")}
        if key == keys.OBSERVATION:
            inputs[name]["columns"] = columns(env.layout[name])
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


def columns(layout: Layout) -> list[dict[str, Any]]:
    """Describe the columns of an observation, in order; the server has scaled them already."""
    return [
        {
            "feature": block.name,
            "columns": block.width,
            "shape": [*block.shape],
            "entries": [*block.entries],
            "low": block.low,
            "high": block.high,
            "meaning": block.meaning,
        }
        for block in layout
    ]


def actions(config: ActionConfig, spec: TensorSpec) -> dict[str, Any]:
    """What an action is: where it leads from the place where the UAV stands."""
    units = {"distance": "m", "heading": "degrees, clockwise from north"}
    if isinstance(spec, Bounded):
        low, high = (bound[0].tolist() for bound in (spec.low, spec.high))
        meaning = (
            "the bounds low and high of an action stand for these; a value beyond counts as the "
            "bound"
        )
        ends = {"distance": [0.0, max(config.distances)], "heading": [0.0, 360.0]}
        return {
            "units": units,
            "columns": [*ends],
            "low": low,
            "high": high,
            **ends,
            "meaning": meaning,
        }
    rows = action_table(config, torch.float64).tolist()
    table = [[distance, math.degrees(heading)] for distance, heading in rows]
    return {
        "meaning": "index of a row",
        "units": units,
        "columns": ["distance", "heading"],
        "table": table,
    }


@cli.program("export")
def main(given: DictConfig) -> None:
    config = cli.checked(given, [], "export")
    if config.checkpoint is None:
        raise InputError("checkpoint: it is missing: the run folder of the policy to export")
    written = Path(config.checkpoint)
    target = export(written, config.trust)
    if not (run_folder(written) / RESULTS).exists() and not written.is_file():
        print(f"{written}: the training has not finished; its latest checkpoint is exported")
    print(f"results: {target}")
