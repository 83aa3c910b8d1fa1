"""The settings of the programs, read from the source of their dataclasses without importing it.

Torch takes seconds to import; a misspelt setting and a question for help should be answered at once.
"""

import ast
import functools
import inspect
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import damian

RECIPES = Path(__file__).parents[1]
CONF = str(RECIPES.parent / "conf")
"""Absolute path of the configuration files; Hydra would look for a relative one beside the calling module."""

SCHEMAS = {
    "train": "damian.recipes.shared.settings:TrainConfig",
    "compare": "damian.recipes.compare:CompareConfig",
    "fly": "damian.recipes.fly:FlyConfig",
    "tune": "damian.recipes.tune:TuneConfig",
    "advise": "damian.recipes.advise:AdviseConfig",
}
"""Dataclass of all settings of a program, by the name of its file in conf/."""


@dataclass(frozen=True)
class Setting:
    """A setting as its dataclass declares it."""

    kind: str
    """Type annotation."""
    default: str
    """Default value as source text; empty if there is none, or if it is a section of settings."""
    text: str
    """What the setting means, with its unit."""

    @property
    def is_open(self) -> bool:
        """Whether the keys below this setting are not declared: those of a delay law, elements of a list."""
        return any(word in self.kind for word in ("Any", "dict", "list", "tuple"))


@functools.cache
def known_settings(program: str) -> dict[str, Setting]:
    """Every setting of a program by its dotted key, sections included.

    Args:
        program: one of ``SCHEMAS``.
    """
    return _settings(*SCHEMAS[program].split(":"))


@functools.cache
def default_options(program: str) -> dict[str, str]:
    """The groups of a program, each with the option that applies if none is chosen; ``???`` if one must be.

    Args:
        program: one of ``SCHEMAS``.
    """
    text = Path(CONF, f"{program}.yaml").read_text()
    if "  - defaults\n" in text:
        text += Path(CONF, "defaults.yaml").read_text()
    return dict(re.findall(r"^  - (\w+): (\S+)", text, re.MULTILINE))


def groups(own_folder: str | None = None) -> dict[str, list[str]]:
    """Options of every group of conf/, by the group's name.

    A file _NAME.yaml is no option, but what several options share.

    Args:
        own_folder: a folder with configuration files of the user's own, whose options come first.
    """
    options: dict[str, list[str]] = {}
    for root in map(Path, filter(None, [own_folder, CONF])):
        for folder in (path for path in root.glob("*") if path.is_dir() and path.name != "hydra"):
            files = sorted(folder.rglob("[!_]*.yaml"))
            names = [str(file.relative_to(folder).with_suffix("")) for file in files]
            options.setdefault(folder.name, []).extend(names)
    return options


def _settings(module: str, name: str, path: str = "") -> dict[str, Setting]:
    """The fields of a dataclass and of its bases, and below each field those of its own dataclass."""
    tree, settings = _tree(module), {}
    node = next(n for n in tree.body if isinstance(n, ast.ClassDef) and n.name == name)
    for base in node.bases:
        if isinstance(base, ast.Name) and (found := _find(module, base.id)):
            settings |= _settings(*found, path)
    for i, part in enumerate(node.body):
        if not isinstance(part, ast.AnnAssign) or not isinstance(part.target, ast.Name):
            continue
        key, kind = path + part.target.id, ast.unparse(part.annotation)
        if kind.startswith("ClassVar"):
            continue
        below = _below(module, key, kind)
        default = "" if below or part.value is None else _default(part.value)
        text = _text_after(node.body, i) or (settings[key].text if key in settings else "")
        settings |= {key: Setting(kind, default, text), **below}
    return settings


def _below(module: str, key: str, kind: str) -> dict[str, Setting]:
    """The settings below a field: those of its dataclass, or of the dataclass that its dictionary holds."""
    if kind == "LearnerConfig":
        return _any_of(_learners(), f"{key}.")
    if each := re.fullmatch(r"dict\[str, (\w+)\]", kind):
        key, kind = f"{key}.NAME", each[1]
    found = _find(module, kind)
    return _settings(*found, f"{key}.") if found else {}


def _learners() -> list[tuple[str, str]]:
    """Module and class of the settings of every learner that registers itself; the settings choose one."""
    files = sorted((Path(damian.__file__).parent / "learners").glob("*.py"))
    return [
        (f"damian.learners.{file.stem}", node.name)
        for file in files
        for node in ast.parse(file.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef) and "LEARNERS.register" in map(_called, node.decorator_list)
    ]


def _called(decorator: ast.expr) -> str:
    return ast.unparse(decorator.func) if isinstance(decorator, ast.Call) else ""


def _any_of(classes: Sequence[Sequence[str]], path: str) -> dict[str, Setting]:
    """The settings of dataclasses of which one is chosen; a default says in brackets whose it is."""
    found = {module.rpartition(".")[2]: _settings(module, name, path) for module, name in classes}
    merged = {}
    for key in dict.fromkeys(key for settings in found.values() for key in settings):
        having = {name: settings[key] for name, settings in found.items() if key in settings}
        first = next(iter(having.values()))
        owners: dict[str, list[str]] = {}
        for name, setting in having.items():
            if setting.default:
                owners.setdefault(setting.default, []).append(name)
        agree = len(having) == len(found) and len(owners) <= 1
        owned = " or ".join(f"{default} ({', '.join(names)})" for default, names in owners.items())
        text = next((setting.text for setting in having.values() if setting.text), "")
        merged[key] = Setting(first.kind, first.default if agree else owned, text)
    return merged


def _default(value: ast.expr) -> str:
    """The default value of a field as source text, without ``field(default_factory=...)``."""
    if isinstance(value, ast.Call) and value.keywords:
        made = value.keywords[0].value
        return ast.unparse(made.body) if isinstance(made, ast.Lambda) else f"{ast.unparse(made)}()"
    return ast.unparse(value)


def _text_after(body: list[ast.stmt], i: int) -> str:
    """The docstring of the field that is statement ``i`` of a class."""
    following = body[i + 1] if i + 1 < len(body) else None
    if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
        return inspect.cleandoc(str(following.value.value))
    return ""


def _find(module: str, name: str) -> tuple[str, str] | None:
    """Module and name of a class of DAMIAN that a module defines or imports under a name."""
    for node in _tree(module).body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return module, name
        if isinstance(node, ast.ImportFrom) and any(alias.name == name for alias in node.names):
            origin = _absolute(node, module)
            return (origin, name) if origin.startswith("damian.") else None
    return None


def _absolute(node: ast.ImportFrom, module: str) -> str:
    """The module from which a statement of another module imports."""
    package = module.split(".")[: -node.level] if node.level else []
    return ".".join([*package, *filter(None, [node.module])])


@functools.cache
def _tree(module: str) -> ast.Module:
    parts = module.split(".")[1:]
    folder = RECIPES.parent if parts[0] == "recipes" else Path(damian.__file__).parent
    return ast.parse((folder.joinpath(*parts)).with_suffix(".py").read_text())
