"""The settings of the programs, read from the source of their dataclasses without importing it.

Torch takes seconds to import; a misspelt setting and a question for help should be answered at once.
"""

import ast
import functools
import inspect
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from omegaconf import OmegaConf

import damian

RECIPES = Path(__file__).parents[1]
CONF = str(RECIPES.parent / "conf")
"""Absolute path of the configuration files; Hydra would look for a relative one beside the calling module."""

SCHEMAS = {
    "train": "damian.recipes.shared.settings:TrainConfig",
    "compare": "damian.recipes.compare:CompareConfig",
}
"""Dataclass of all settings of a program, by the name of its file in conf/."""
CHOICES = {"LearnerConfig": ["damian.learners.mappo:MappoConfig", "damian.learners.sac:SacConfig"]}
"""Dataclasses that stand for another one, as the settings choose."""


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
        """Whether the keys below this setting are not declared, such as those of a delay law."""
        return "Any" in self.kind or "dict" in self.kind


@functools.cache
def known_settings(program: str) -> dict[str, Setting]:
    """Every setting of a program by its dotted key, sections included.

    Args:
        program: one of ``SCHEMAS``.
    """
    known: dict[str, Setting] = {}
    for key, setting in _settings(*SCHEMAS[program].split(":")):
        before = known.get(key, setting)  # another learner or a base class may declare it too
        defaults = dict.fromkeys([before.default, setting.default])
        known[key] = replace(setting, default=" or ".join(defaults), text=setting.text or before.text)
    return known


def groups(own_folder: str | None = None) -> dict[str, list[str]]:
    """Options of every group of conf/, by the group's name.

    Args:
        own_folder: a folder with configuration files of the user's own, whose options come first.
    """
    options: dict[str, list[str]] = {}
    for root in map(Path, filter(None, [own_folder, CONF])):
        for folder in (path for path in root.glob("*") if path.is_dir() and path.name != "hydra"):
            files = sorted(folder.rglob("*.yaml"))
            names = [str(file.relative_to(folder).with_suffix("")) for file in files]
            options.setdefault(folder.name, []).extend(names)
    return options


def help_text(recipe: str, program: str, keys: Sequence[str] = ()) -> str:
    """What ``--help`` prints: a page on the program, or the meaning of settings.

    Args:
        recipe: name of a file of recipes/.
        program: one of ``SCHEMAS``.
        keys: dotted keys of settings or sections to explain.
    """
    if keys:
        return "\n".join(_explain(program, key) or f"{key}: no such key" for key in keys)
    if recipe == "train":
        return str(OmegaConf.load(Path(CONF, "hydra", "help", "train.yaml")).template)
    text = ast.get_docstring(ast.parse((RECIPES / f"{recipe}.py").read_text())) or ""
    return f"{text}\n\nSettings: damian train --help, damian {recipe} --help KEY."


def _explain(program: str, key: str) -> str:
    """Key, type, default and meaning of a setting, or of all settings of a section."""
    chosen = {k: s for k, s in known_settings(program).items() if k == key or k.startswith(f"{key}.")}
    lines = []
    for name, setting in chosen.items():
        default = f" = {setting.default}" if setting.default else ""
        lines += [f"{name}: {setting.kind}{default}", *(f"    {line}" for line in setting.text.splitlines())]
    return "\n".join(lines)


def _settings(module: str, name: str, path: str = "") -> Iterator[tuple[str, Setting]]:
    """The fields of a dataclass and of its bases, and below each field those of its own dataclass."""
    tree = _tree(module)
    node = next(n for n in tree.body if isinstance(n, ast.ClassDef) and n.name == name)
    for base in node.bases:
        if isinstance(base, ast.Name) and (found := _find(module, base.id)):
            yield from _settings(*found, path)
    for i, part in enumerate(node.body):
        if not isinstance(part, ast.AnnAssign) or not isinstance(part.target, ast.Name):
            continue
        key, kind = path + part.target.id, ast.unparse(part.annotation)
        if kind.startswith("ClassVar"):
            continue
        chosen = [class_path.partition(":") for class_path in CHOICES.get(kind, [])]
        sections = [(module, name) for module, _, name in chosen] or [_find(module, kind)]
        default = "" if sections[0] or part.value is None else _default(part.value)
        yield key, Setting(kind, default, _text_after(node.body, i))
        for section in filter(None, sections):
            yield from _settings(*section, f"{key}.")


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
