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
every_policy = pytest.mark.parametrize(
    "words",
    [HISTORY, *(pytest.param(words, marks=pytest.mark.slow) for words in (GRU, CONTINUOUS, BELIEF))],
    ids=["history", "gru", "continuous", "belief"],
)


@every_policy
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
    check_description(described, inputs, torch.load(folder / "weights.pt"))


def check_description(described: dict, inputs: dict, weights: dict) -> None:
    """Columns and actions are as many as there are, and each action leads where the table says."""
    columns = described["inputs"]["observation"]["columns"]
    assert sum(each["columns"] for each in columns) == inputs["observation"].shape[-1]
    assert all(each["meaning"] for each in columns)
    assert ("limit" in described) == any("belief" in each["feature"] for each in columns)
    assert weights
    if "table" in described["actions"]:
        assert len(described["actions"]["table"]) == inputs["action_mask"].shape[-1]
        assert described["actions"]["table"][9] == [50.0, -90.0]


OWN = """
from dataclasses import dataclass

from tensordict.nn import TensorDictModule
from torch import distributions, nn
from torchrl.modules import IndependentNormal, Ordinal, ProbabilisticActor

from damian import LearnerConfig, keys

class Beta(distributions.Independent):
    def __init__(self, loc, scale):
        super().__init__(distributions.Beta(loc, scale), 1)

class Drawn(Beta):
    deterministic_sample = property(lambda self: self.rsample())

class Split(nn.Linear):
    def forward(self, x):
        return tuple(1.5 + part.tanh() for part in super().forward(x).chunk(2, -1))

class Branches(Split):
    def forward(self, x):
        return super().forward(x if x.sum() > 0 else -x)

@dataclass
class StillConfig(LearnerConfig):
    law: str = "Beta"

    def make(self, env, setup, buffer):
        return Still(self.make_actor(env, setup.model))

    def make_actor(self, env, model):
        spec = env.full_action_spec_unbatched[keys.ACTION]
        width = env.observation_spec[keys.OBSERVATION].shape[-1]
        kind = globals()[self.law if self.law != "Branches" else "Beta"]
        discrete = kind is Ordinal
        split = Branches if self.law == "Branches" else Split
        network = nn.Linear(width, spec.n) if discrete else split(width, 4)
        names = ["scores"] if discrete else ["loc", "scale"]
        return ProbabilisticActor(
            TensorDictModule(network, [keys.OBSERVATION], [("agents", name) for name in names]),
            in_keys=dict(zip(names, [("agents", name) for name in names])),
            out_keys=[keys.ACTION],
            distribution_class=kind,
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
        words = [f"learner.law={law}", *["actions=continuous"] * (law != "Ordinal"), "hydra.run.dir=run"]
        main(["train", *TRAINED, "learner=own:StillConfig", *words])
        return tmp_path / "run"

    return train


@pytest.mark.parametrize("law", ["Beta", "IndependentNormal", "Ordinal"])
def test_the_own_action_of_an_actor_from_outside_is_exported_exactly_whatever_its_distribution(law, trained):
    run = trained(law)
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
    spec = env.full_action_spec_unbatched[keys.ACTION]
    if law != "Ordinal":
        assert list(described["outputs"]) == ["action", "loc", "scale"]
        assert described["actions"]["low"] == spec.space.low[0].tolist() == [0.0, 0.0]
        assert described["actions"]["high"] == spec.space.high[0].tolist() == [1.0, 1.0]
    assert described["distribution"] == {"class": law}


@pytest.mark.parametrize(
    ("law", "message"),
    [
        ("Drawn", "Drawn needs a property deterministic_sample: without it the action is drawn by chance"),
        ("Branches", "own:StillConfig cannot be exported: "),
    ],
)
def test_an_actor_that_no_program_can_stand_for_is_refused_in_one_line(law, message, trained, capsys):
    run = trained(law)
    check_refused(lambda: main(["export", str(run), "trust=true"]), message, capsys)
    assert not (run / "export").exists()


def test_what_cannot_be_exported_is_refused_in_one_line(capsys, tmp_path):
    for words, message in (([], "checkpoint: it is missing"), ([str(tmp_path)], "holds no config.yaml")):
        with pytest.raises(SystemExit):
            main(["export", *words])
        assert message in capsys.readouterr().err
    assert [*Path(tmp_path).iterdir()] == []
