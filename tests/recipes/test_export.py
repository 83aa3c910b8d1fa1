"""An exported policy, run in a process without damian, chooses the same actions as the loaded one."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import onnxruntime
import pytest
import torch
from helpers import check_refused
from test_evaluate import TRAINED

import damian
from damian import keys
from damian.recipes.command import main

WITHOUT_DAMIAN = """
import sys, torch, onnxruntime, numpy
sys.modules["damian"] = sys.modules["tensordict"] = sys.modules["torchrl"] = None  # an import of them fails
inputs = torch.load("inputs.pt")
torch.save(torch.export.load("policy.pt2").module()(*inputs.values()), "program.pt")
session = onnxruntime.InferenceSession("policy.onnx")
given = {name: value.numpy() for name, value in inputs.items()}
torch.save([torch.as_tensor(each) for each in session.run(None, given)], "onnx.pt")
from safetensors.torch import load_file
torch.save(load_file("policy.safetensors"), "weights.pt")
"""

HISTORY, GRU = ["delay.history=2"], ["model=gru"]
CONTINUOUS = ["learner=sac", "actions=continuous", "learner.warm_up=8", "learner.batch_size=8"]
BELIEF = ["observation.belief=[belief_gain]", "model.skip=true"]
BELIEF += ["observation.global_features=[agent_distances]"]  # for three UAVs alone


@pytest.mark.parametrize(
    "words",
    [HISTORY, *(pytest.param(words, marks=pytest.mark.slow) for words in (GRU, CONTINUOUS, BELIEF))],
    ids=["history", "gru", "continuous", "belief"],
)
def test_an_exported_policy_chooses_the_same_without_damian(words, tmp_path):
    main(["train", *TRAINED, *words, f"hydra.run.dir={tmp_path / 'run'}"])
    main(["export", str(tmp_path / "run")])
    folder = tmp_path / "run" / "export"
    described = json.loads((folder / "policy.json").read_text())
    n_uavs = 5 if described["uavs"] == "any number" else 3
    policy, env = damian.load(tmp_path / "run", f"agents={n_uavs}", worlds=7, deterministic=True)
    rollout = env.rollout(4, policy, break_when_any_done=False)[:, -1]
    key_of = {"hidden": keys.HIDDEN_BEFORE}
    inputs = {name: rollout[key_of.get(name, ("agents", name))] for name in described["inputs"]}
    torch.save(inputs, folder / "inputs.pt")
    subprocess.run([sys.executable, "-c", WITHOUT_DAMIAN], cwd=folder, check=True)
    for file in ("program.pt", "onnx.pt"):
        outputs = dict(zip(described["outputs"], torch.load(folder / file), strict=True))
        torch.testing.assert_close(outputs["action"], rollout[keys.ACTION], rtol=1e-4, atol=1e-5)
        for name in {*outputs} - {"action", "probability"}:
            torch.testing.assert_close(outputs[name], rollout["agents", name], rtol=1e-4, atol=1e-5)
        if "probability" in outputs:
            log_prob = outputs["probability"].log().gather(-1, rollout[keys.ACTION].unsqueeze(-1)).squeeze(-1)
            torch.testing.assert_close(log_prob, rollout[keys.ACTION_LOG_PROB], rtol=1e-4, atol=1e-5)
    assert torch.load(folder / "weights.pt")
    columns = described["inputs"]["observation"]["columns"]
    assert sum(each["columns"] for each in columns) == inputs["observation"].shape[-1]
    assert all(each["meaning"] for each in columns)
    assert ("limit" in described) == any("belief" in each["feature"] for each in columns)
    if "table" in described["actions"]:
        assert len(described["actions"]["table"]) == inputs["action_mask"].shape[-1]
        assert described["actions"]["table"][9] == [50.0, -90.0]


OWN = """
from dataclasses import dataclass

from tensordict.nn import TensorDictModule
from torch import distributions, nn
from torchrl.modules import ProbabilisticActor

from damian import LearnerConfig, keys

class Beta(distributions.Independent):
    def __init__(self, loc, scale):
        super().__init__(distributions.Beta(loc, scale), 1)

class Drawn(Beta):
    deterministic_sample = property(lambda self: self.rsample())

class Split(nn.Linear):
    def forward(self, x):
        return tuple(1.5 + part.tanh() for part in super().forward(x).chunk(2, -1))

@dataclass
class StillConfig(LearnerConfig):
    law: str = "Beta"

    def make(self, env, setup, buffer):
        return Still(self.make_actor(env, setup.model))

    def make_actor(self, env, model):
        width = env.observation_spec[keys.OBSERVATION].shape[-1]
        names = [("agents", "loc"), ("agents", "scale")]
        return ProbabilisticActor(
            TensorDictModule(Split(width, 4), [keys.OBSERVATION], names),
            in_keys={"loc": names[0], "scale": names[1]},
            out_keys=[keys.ACTION],
            distribution_class=globals()[self.law],
            return_log_prob=True,
            log_prob_key=keys.ACTION_LOG_PROB,
        )

class Still:
    def __init__(self, actor):
        self.actor = actor

    def components(self):
        return {"actor": self.actor}

    def learn(self, batch):
        return {}
"""


@pytest.fixture
def trained(tmp_path, monkeypatch) -> Callable[[str], Path]:
    """Train with a learner of a file in an empty folder, whose actor draws from a given distribution."""
    (tmp_path / "own.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "own", raising=False)

    def train(law: str) -> Path:
        words = [f"learner.law={law}", "actions=continuous", "hydra.run.dir=run"]
        main(["train", *TRAINED, "learner=own:StillConfig", *words])
        return tmp_path / "run"

    return train


def test_the_own_action_of_an_actor_from_outside_is_exported_exactly(trained):
    run = trained("Beta")
    main(["export", str(run), "trust=true"])
    described = json.loads((run / "export" / "policy.json").read_text())
    policy, env = damian.load(run, worlds=7, deterministic=True, trust=True)
    steps = env.rollout(4, policy, break_when_any_done=False).flatten()
    inputs = [steps["agents", name] for name in described["inputs"]]
    outputs = torch.export.load(run / "export" / "policy.pt2").module()(*inputs)
    assert outputs[0].equal(steps[keys.ACTION])
    session = onnxruntime.InferenceSession(run / "export" / "policy.onnx")
    given = {name: each.numpy() for name, each in zip(described["inputs"], inputs, strict=True)}
    torch.testing.assert_close(torch.as_tensor(session.run(None, given)[0]), steps[keys.ACTION])
    assert list(described["outputs"]) == ["action", "loc", "scale"]
    assert described["actions"]["low"] == env.full_action_spec_unbatched[keys.ACTION].space.low[0].tolist()
    assert described["distribution"] == {"class": "Beta"}


def test_what_cannot_be_exported_is_refused_in_one_line(trained, capsys, tmp_path):
    run, message = (
        trained("Drawn"),
        "Drawn needs a property deterministic_sample: without it the action is drawn",
    )
    check_refused(lambda: main(["export", str(run), "trust=true"]), message, capsys)
    assert not (run / "export").exists()
    check_refused(lambda: main(["export"]), "checkpoint: it is missing", capsys)
    check_refused(lambda: main(["export", str(tmp_path)]), "holds no config.yaml", capsys)
