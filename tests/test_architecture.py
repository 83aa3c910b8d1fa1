"""The file tree: which folder may import which."""

import ast
import re
import tomllib
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

import damian
from damian.interop.fleet import PUBLIC
from damian.world.messages import Messages

ROOT = Path(damian.__file__).parent
RECIPES = ROOT.parent / "recipes"
TREE = (ROOT.parent / "CONTRIBUTING.md").read_text("utf-8").partition("\ndamian/\n")[2]
ROOMS = re.findall(r"^  (\w+)(?:/|\.py) ", TREE.partition("\nconf/")[0], re.MULTILINE)
"""Folders and modules of ``damian``, as CONTRIBUTING.md lists them: each imports only from those
above it."""
MOST_ROOMS = 16
DOORS = ("damian", "damian.interop")
"""Modules with the public names of programs, which are loaded when one is used."""
FOR_ALL = (
    "damian.recipes.shared",
    "damian.recipes.cli",
    "damian.recipes.known",
    "damian.recipes.config",
)
"""What the programs share."""


def module_of(path):
    """Name of a module, as it is installed: the recipes are a package of damian."""
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    parts = ("damian", *parts) if parts[0] == "recipes" else parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {
    module_of(path): path for folder in (ROOT, RECIPES) for path in sorted(folder.rglob("*.py"))
}
FILES = [*MODULES.values()]
HEAVY = ("shapely", "hydra", "omegaconf", "matplotlib")


@cache
def parsed(path):
    return ast.parse(path.read_text("utf-8"))


def imported(module, strings=False):
    """Every module, or name within one, that a module imports anywhere; also those that ``strings``
    name."""
    package = module if MODULES[module].name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(parsed(MODULES[module])):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = (
                package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            )
            within = ".".join([*above, *[node.module] * bool(node.module)])
            yield from (f"{within}.{alias.name}" for alias in node.names)
        elif strings and isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield from re.findall(r"^(damian(?:\.\w+)+)(?::\w+)?$", node.value)


def is_in(name, modules):
    """Whether a module, or a name within one, is one of these modules or in one of them."""
    return any(f"{name}.".startswith(f"{module}.") for module in modules)


def test_the_document_lists_every_room_and_there_are_few():
    rooms = {
        path.stem
        for path in ROOT.iterdir()
        if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert rooms - {"__init__"} == set(ROOMS)
    assert len(rooms) <= MOST_ROOMS + 1


def test_a_module_imports_only_from_its_own_room_and_from_those_above_it():
    places = [f"damian.{room}" for room in (*ROOMS, "recipes")]
    for module in set(MODULES) - {*DOORS}:
        room = next(place for place in places if is_in(module, [place]))
        below = places[places.index(room) + 1 :]
        for name in imported(module, strings=True):
            assert not is_in(name, below), f"{module} imports {name}"


def test_what_the_recipes_share_imports_no_program():
    for module in MODULES:
        if is_in(module, FOR_ALL):
            for name in imported(module, strings=True):
                assert not is_in(name, ["damian.recipes"]) or is_in(name, FOR_ALL), (
                    f"{module} imports {name}"
                )


def test_an_installation_has_every_folder_of_the_package_the_recipes_and_the_configuration():
    setup = tomllib.loads((ROOT.parent / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {path.parent for path in ROOT.rglob("__init__.py")}
    packages = {".".join(folder.relative_to(ROOT.parent).parts) for folder in folders}
    packages |= {"damian.conf", "damian.recipes", "damian.recipes.shared"}
    assert set(setup["packages"]) == packages


@cache
def loaded(module):
    """The modules that a module loads, but for those that it is in."""
    parts = [name.split(".") for name in imported(module)]
    names = {".".join(each[:n]) for each in parts for n in range(1, len(each) + 1)}
    return {name for name in names & MODULES.keys() if not is_in(module, [name])}


def test_the_transforms_load_without_what_the_world_of_the_uavs_needs():
    reached = {"damian.transforms"}
    while more := {name for module in reached for name in loaded(module)} - reached:
        reached |= more
    assert "damian.delays.line" in reached
    assert not [
        (module, name) for module in reached for name in imported(module) if is_in(name, HEAVY)
    ]


def test_no_modules_import_each_other_in_a_circle():
    edges = {module: loaded(module) for module in MODULES}
    assert "damian.recipes.known" in edges["damian.recipes.cli"]
    while leaves := {module for module, others in edges.items() if not others}:
        edges = {
            module: others - leaves for module, others in edges.items() if module not in leaves
        }
    assert edges == {}


def test_every_file_says_in_a_sentence_what_it_is_for():
    assert not [path for path in FILES if not ast.get_docstring(parsed(path))]


def test_text_is_read_and_written_as_utf_8_everywhere():
    """Where the type of a path is not known, ruff (PLW1514) does not see that the encoding is
    missing."""
    for path in (
        each
        for folder in ("damian", "recipes", "examples")
        for each in (ROOT.parent / folder).rglob("*.py")
    ):
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") in (
                "read_text",
                "write_text",
            ):
                assert "encoding" in {each.arg for each in node.keywords}, f"{path}:{node.lineno}"


def test_every_public_name_exists_and_is_loaded_on_demand():
    text = Path(damian.__file__).read_text("utf-8")
    assert {*re.findall(r"\b(\w+) as \1\b", text)} == {*damian._MODULE_OF}
    assert all(getattr(damian, name).__name__ == name for name in damian._MODULE_OF)
    with pytest.raises(AttributeError, match="no attribute nothing"):
        _ = damian.nothing


def test_the_service_for_fleets_fills_every_column_of_a_message():
    """Its own tests need further packages, and run by ``make fleet``."""
    path = ROOT.parent / "examples/fleet/damian_fleet/known.py"
    called = [node for node in ast.walk(parsed(path)) if isinstance(node, ast.Call)]
    (made,) = [each for each in called if getattr(each.func, "id", "") == "Messages"]
    assert {each.arg for each in made.keywords} == {*Messages._fields}


@pytest.mark.parametrize("line", PUBLIC.strip().splitlines())
def test_the_names_that_fleets_may_use_exist(line):
    module, names = line.split(": ")
    found = import_module(module)
    assert [name for name in names.split(", ") if not hasattr(found, name)] == []
