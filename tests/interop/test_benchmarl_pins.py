"""The environment of examples/benchmarl, which `make benchmarl` installs, fits this version of DAMIAN."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import damian

ROOT = Path(damian.__file__).parents[1]
PINS = dict(
    re.findall(r"^([\w-]+)==(\S+)$", (ROOT / "examples/benchmarl/requirements.txt").read_text(), re.M)
)
NEEDED = [
    Requirement(line)
    for line in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
]


@pytest.mark.parametrize("name", ["torch", "torchrl", "tensordict"])
def test_a_pin_is_a_version_that_damian_allows(name):
    (allowed,) = [each.specifier for each in NEEDED if each.name == name]
    assert PINS[name] in allowed


def test_torch_is_the_one_of_the_makefile():
    assert f"TORCH  ?= torch=={PINS['torch']}\n" in (ROOT / "Makefile").read_text()
