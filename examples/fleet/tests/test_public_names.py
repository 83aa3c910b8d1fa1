"""The distribution stands on what others may use of damian, and on nothing else of it."""

import ast
from importlib import import_module
from pathlib import Path

from damian.interop.fleet import PUBLIC

FILES = sorted((Path(__file__).parents[1] / "damian_fleet").rglob("*.py"))
TABLE = dict(line.split(": ") for line in PUBLIC.strip().splitlines())
NAMES = {(module, name) for module, names in TABLE.items() for name in names.split(", ")}


def imported() -> set[tuple[str, str]]:
    """Names of damian that the distribution imports, by their modules."""
    found = set()
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "damian":
                found |= {(node.module, name.name) for name in node.names}
            elif isinstance(node, ast.Import):
                names = [name.name for name in node.names]
                assert not [name for name in names if name.startswith(("damian.", "recipes"))], path
    return found


def test_it_imports_the_public_names_of_damian_and_no_others():
    assert FILES
    assert imported() == NAMES


def test_every_public_name_exists():
    for module, name in NAMES:
        assert hasattr(import_module(module), name), f"{module}.{name}"
