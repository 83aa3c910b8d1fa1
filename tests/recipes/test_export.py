"""An exported policy, run where damian cannot be imported, chooses the same actions as the loaded
one."""

import json
import re
import sys

import onnxruntime
import pytest
import torch
from helpers import check_refused
from test_evaluate import TRAINED

import damian
from damian import keys
from damian.recipes.command import main

HISTORY = ["delay.history=2"]
GRU = ["model=gru"]
CONTINUOUS = ["learner=sac", "actions=continuous", "learner.warm_up=8", "learner.batch_size=8"]
BELIEF = ["observation.belief=[belief_gain]", "model.prior=true"]
BELIEF += ["observation.global_features=[agent_distances]"]  # for three UAVs alone
OWN = ["model.shared=false", "source.count=2", "observation.belief=[belief_moments]"]


@pytest.mark.parametrize(
    "words",
    [
        HISTORY,
        *(pytest.param(words, marks=pytest.mark.slow) for words in (GRU, CONTINUOUS, BELIEF, OWN)),
    ],
)
def test_an_exported_policy_chooses_the_same_without_damian(words, tmp_path, monkeypatch):
    main(["train", *TRAINED, *words, f"hydra.run.dir={tmp_path / 'run'}"])
    main(["export", str(tmp_path / "run")])
    folder = tmp_path / "run" / "export"
    described = json.loads((folder / "policy.json").read_text())
    n_uavs = 5 if described["uavs"] == "any number" else 3
    policy, env = damian.load(
        tmp_path / "run", f"agents={n_uavs}", num_worlds=7, deterministic=True
    )
    rollout = env.rollout(4, policy, break_when_any_done=False)[:, -1]
    key_of = {"hidden": keys.HIDDEN_BEFORE}
    inputs = {name: rollout[key_of.get(name, ("agents", name))] for name in described["inputs"]}
    others = ("damian", "tensordict", "torchrl")
    for name in others:
        monkeypatch.setitem(sys.modules, name, None)  # an import of them fails
    program = torch.export.load(folder / "policy.pt2")
    assert not re.search("|".join(others), str(program.graph)), "an operator of theirs"
    session = onnxruntime.InferenceSession(folder / "policy.onnx")
    given = {name: value.numpy() for name, value in inputs.items()}
    onnx = map(torch.as_tensor, session.run(None, given))
    for found in (program.module()(*inputs.values()), onnx):
        outputs = dict(zip(described["outputs"], found, strict=True))
        torch.testing.assert_close(
            outputs["action"],
            rollout[keys.ACTION],
            rtol=1e-4,
            atol=1e-5,
        )
        for name in {*outputs} - {"action", "probability"}:
            torch.testing.assert_close(
                outputs[name],
                rollout["agents", name],
                rtol=1e-4,
                atol=1e-5,
            )
        if "probability" in outputs:
            log_prob = (
                outputs["probability"]
                .log()
                .gather(-1, rollout[keys.ACTION].unsqueeze(-1))
                .squeeze(-1)
            )
            torch.testing.assert_close(
                log_prob, rollout[keys.ACTION_LOG_PROB], rtol=1e-4, atol=1e-5
            )
    columns = described["inputs"]["observation"]["columns"]
    assert sum(each["columns"] for each in columns) == inputs["observation"].shape[-1]
    assert all(each["meaning"] for each in columns)
    assert ("limit" in described) == any("belief" in each["feature"] for each in columns)
    if "table" in described["actions"]:
        assert len(described["actions"]["table"]) == inputs["action_mask"].shape[-1]
        assert described["actions"]["table"][9] == [50.0, -90.0]


def test_what_cannot_be_exported_is_refused_in_one_line(capsys, tmp_path):
    check_refused(lambda: main(["export"]), "checkpoint: it is missing", capsys)
    check_refused(lambda: main(["export", str(tmp_path)]), "holds no config.yaml", capsys)
