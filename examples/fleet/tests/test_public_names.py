"""The distribution stands on what others may use of damian, and on nothing of its programs."""

import ast
from pathlib import Path

FILES = sorted((Path(__file__).parents[1] / "damian_fleet").rglob("*.py"))
ROOMS = ("baselines", "common", "envs", "field", "keys", "learners", "runs", "show", "transforms", "world")
"""Rooms of damian whose names it uses, beside those of ``damian`` itself."""


def test_it_imports_only_public_names_of_damian():
    assert FILES
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "damian":
                room = [*(node.module or "").split("."), ""][1]
                assert room in ("", *ROOMS), f"{path}: {node.module}"
                assert not [name.name for name in node.names if name.name.startswith("_")], path
            elif isinstance(node, ast.Import):
                names = [name.name for name in node.names]
                assert not [name for name in names if name.startswith(("damian.", "recipes"))], path
