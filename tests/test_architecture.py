"""The file tree: which folder may import which."""

import ast
import itertools
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import damian

ROOT = Path(damian.__file__).parent
RECIPES = ROOT.parent / "recipes"
FLOORS = [
    {"common", "keys"},
    {"world", "delays"},
    {"server"},
    {"transforms"},
    {"envs", "replay"},
    {"learners"},
    {"baselines"},
    {"runs", "show"},
    {"compare", "interop", "advice"},
]
"""Folders and modules of ``damian``; each may import only those on lower floors."""
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
ROOMS = 16

FILES = sorted(path for folder in (ROOT, RECIPES) for path in folder.rglob("*.py"))
MODULES = {".".join(path.relative_to(ROOT.parent).with_suffix("").parts): path for path in FILES}
"""Files by module; those of the recipes without the ``damian`` that an installation puts before it."""


def imported(path: Path) -> Iterator[str]:
    """Every module, or name within one, that a file imports."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room(module: str) -> str:
    """Folder or module at the top of ``damian``."""
    return module.split(".")[1]


def test_every_room_has_a_floor_and_there_are_few():
    rooms = {path.stem for path in ROOT.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert rooms - {"__init__"} == set(FLOOR)
    assert len(rooms) <= ROOMS


def test_a_module_imports_only_from_its_own_folder_and_lower_floors():
    for module, path in MODULES.items():
        if not module.startswith("damian.") or module == "damian.__init__":  # which has the public names
            continue
        for name in imported(path):
            if name.startswith("damian.") and room(name) != room(module):
                assert FLOOR[room(name)] < FLOOR[room(module)], f"{module} imports {name}"


def test_the_package_never_imports_the_recipes():
    for path in {*ROOT.rglob("*.py")} - {ROOT / "__init__.py"}:  # which has the public names
        assert not [name for name in imported(path) if "recipes" in name.split(".")], path


def test_what_the_recipes_share_imports_no_recipe():
    for path in (RECIPES / "shared").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            beside = ("cli", "config", "known")  # what the programs share of the command line
            assert not isinstance(node, ast.ImportFrom) or node.level <= 1 or node.module in beside, path


def test_an_installation_has_every_folder_of_the_package_the_recipes_and_the_configuration():
    setup = tomllib.loads((ROOT.parent / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {path.parent for path in ROOT.rglob("__init__.py")}
    packages = {".".join(folder.relative_to(ROOT.parent).parts) for folder in folders}
    packages |= {"damian.conf", "damian.recipes", "damian.recipes.shared"}
    assert set(setup["packages"]) == packages


def test_no_modules_import_each_other_in_a_circle():
    known = {m.removesuffix(".__init__"): {*imported(path)} for m, path in MODULES.items() if "damian." in m}
    edges = {
        m: {
            other
            for other in known
            if not m.startswith(other) and any(f"{name}.".startswith(f"{other}.") for name in names)
        }
        for m, names in known.items()
    }
    while leaves := {m for m, others in edges.items() if not others}:
        edges = {m: others - leaves for m, others in edges.items() if m not in leaves}
    assert edges == {}


def test_every_file_says_in_a_sentence_what_it_is_for():
    assert not [path for path in FILES if not ast.get_docstring(ast.parse(path.read_text()))]


def test_text_is_read_and_written_as_utf_8_everywhere():
    """Where the type of a path is not known, ruff (PLW1514) does not see that the encoding is missing."""
    for path in (
        each for folder in ("damian", "recipes", "examples") for each in (ROOT.parent / folder).rglob("*.py")
    ):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") in ("read_text", "write_text"):
                assert "encoding" in {each.arg for each in node.keywords}, f"{path}:{node.lineno}"


def test_every_public_name_exists_and_is_loaded_on_demand():
    assert sorted(itertools.chain(*damian._MODULES.values())) == sorted(damian.__all__)
    assert all(getattr(damian, name).__name__ == name for name in damian.__all__)
    with pytest.raises(AttributeError, match="no attribute nothing"):
        _ = damian.nothing


def test_the_transforms_load_without_the_world_of_the_uavs():
    heavy = ["shapely", "hydra", "omegaconf", "matplotlib", "damian.world", "damian.server", "damian.envs"]
    code = f"import sys, damian.transforms; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
