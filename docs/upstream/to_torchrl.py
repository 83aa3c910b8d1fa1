"""Writes the delays of DAMIAN into a checkout of TorchRL, as a pull request would have them.

    git clone https://github.com/pytorch/rl ../rl
    python docs/upstream/to_torchrl.py ../rl
    cd ../rl && pytest test/transforms/test_delay_transforms.py

The code is that of ``damian``, but for laws by name, in whose place ``laws.py`` stands, and for how
stored steps are corrected. What the three transforms do not use is left out.
"""

import ast
import re
import shutil
import sys
from pathlib import Path
from typing import NamedTuple

import damian

ROOTS = ("ActionDelay", "ObservationDelay", "ObservationTimeline", "set_seed")
MODULES = (
    "errors",
    "checks",
    "text_files",
    "tensors",
    "counter_rng",
    "keys",
    "samplers",
    "laws",
    "line",
)
MODULES += ("entries", "base", "context", "observation", "action", "timeline")
QUALIFIED = ("checks", "counter_rng")
"""Modules whose functions are named together with them."""
OWN, FOLDER = Path(__file__).parent, Path("torchrl", "envs", "transforms", "delays")
HEADER = """# Copyright (c) Meta Platforms, Inc. and affiliates.
#
# This source code is licensed under the MIT license found in the
# LICENSE file in the root directory of this source tree.
"""
SAYS = {
    r"\n    def (hindsight|_corrected)\((.|\n)*?(?=\n    def |\n    @|\n    #|\Z)": "\n",
    r" \(paper, section [\d.]+\)": "",
    r"damian\.set_seed": "set_seed",
    r"the transforms of damian": "the delays",
    r"damian's transforms": "the transforms",
    r"; a recipe prints it and exits with code 2": "",
    r" An environment of\n    ``make_env`` needs only its own ``env.set_seed``\.": "",
    r" ``DelayedEnv``\n    calls them for several, which compile into one graph\.": "",
    r"; for stored steps: examples/\S+\.py": "",
    r'a time \(``"3s"``\), a distribution \(``Uniform\(3, 7\)``\)': "shortest and longest (``(3, 7)``)",
    r"Uniform\((\d), (\d)\)": r"(\1, \2)",
    r"; back-updating needs it": "",
    r" or ``Channel\(\.\.\., delay_key=\.\.\.\)``": "",
}
"""What stands in the place of what TorchRL does not have, by regular expression."""


class Part(NamedTuple):
    """A statement of a module, with the comments above it and the sentence below it."""

    text: str
    defines: set[str]
    uses: set[str]


class Module(NamedTuple):
    """A module: its statements, the first of which is its docstring, and its imports."""

    parts: list[Part]
    imports: list[ast.Import | ast.ImportFrom]


def read(name: str) -> Module:
    """A module of ``damian``, or of this folder."""
    rooms = ("transforms", "delays", "common", ".")
    files = [Path(damian.__file__).parent / room / f"{name}.py" for room in rooms]
    found = next(file for file in files if file.exists())
    text = (OWN / "laws.py" if name == "laws" else found).read_text(encoding="utf-8")
    for pattern, instead in SAYS.items():
        text = re.sub(pattern, instead, text)
    module, lines, end = Module([], []), text.splitlines(), 0
    for node in ast.parse(text).body:
        begin, end = end, node.end_lineno or 0
        if isinstance(node, ast.Import | ast.ImportFrom):
            module.imports.append(node)
            continue
        here, inside = "\n".join(lines[begin:end]).strip("\n"), [*ast.walk(node)]
        if isinstance(node, ast.Expr) and module.parts:
            module.parts[-1] = module.parts[-1]._replace(text=f"{module.parts[-1].text}\n{here}")
            continue
        named = {n.id for n in inside if isinstance(n, ast.Name)}
        of_modules = {
            n.attr
            for n in inside
            if isinstance(n, ast.Attribute) and ast.unparse(n.value) in QUALIFIED
        }
        whole = isinstance(node, ast.FunctionDef | ast.ClassDef)
        stored = {n.id for n in inside if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        module.parts.append(Part(here, {node.name} if whole else stored, named | of_modules))
    return module


def imported(node: ast.Import | ast.ImportFrom, used: set[str]) -> str:
    """An import of what is used, from the package if it is one of ``damian``; empty if nothing
    is."""
    names = [each for each in node.names if (each.asname or each.name).partition(".")[0] in used]
    if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("damian"):
        last = (node.module or "").rpartition(".")[2]
        node = ast.ImportFrom(last if last in MODULES else None, names, 1)
    elif isinstance(node, ast.ImportFrom):
        specs = node.module == "torchrl.data"  # which imports the transforms before it has names
        node = ast.ImportFrom("torchrl.data.tensor_specs" if specs else node.module, names, 0)
    return ast.unparse(node) if names else ""


def insert(text: str, file: Path, before: str | None = None) -> None:
    """Insert a text into a file that does not have it, before a line or at the end."""
    old = file.read_text(encoding="utf-8")
    place = old.index(before) if before else len(old)
    if text not in old:
        file.write_text(old[:place] + text + old[place:], encoding="utf-8")


def main(checkout: Path) -> None:
    """Write the package, its names among TorchRL's, its entry in the documents, and its tests."""
    modules = {name: read(name) for name in MODULES}
    every, needed = [part for module in modules.values() for part in module.parts], {*ROOTS}
    while more := {u for p in every if p.defines & needed for u in p.uses} - needed:
        needed |= more
    (checkout / FOLDER).mkdir(parents=True, exist_ok=True)
    for name, (parts, imports) in modules.items():
        kept = [part for part in parts[1:] if part.defines & needed or not part.defines]
        used = {each for part in kept for each in part.uses}
        heads = [line for line in (imported(node, used) for node in imports) if line]
        text = "\n\n".join(
            [HEADER + parts[0].text, "\n".join(["from __future__ import annotations", *heads])]
        )
        text = "\n\n\n".join([text, *(part.text for part in kept)]) + "\n"
        if left := re.findall(r".*(?:damian|paper|back-updat).*", text, re.IGNORECASE):
            sys.exit(f"{name}: say this without DAMIAN: {left}")
        (checkout / FOLDER / f"{name}.py").write_text(text, encoding="utf-8")
    names = [*ROOTS[:3]]
    lines = [
        HEADER
        + '"""Delays of observations and actions, and what is known of the latest steps."""\n'
    ]
    lines += [
        f"from .{module} import {name}"
        for module, name in zip(("action", "observation", "timeline"), names, strict=True)
    ]
    lines += ["from .base import set_seed", f"\n__all__ = {[*ROOTS]}\n"]
    (checkout / FOLDER / "__init__.py").write_text("\n".join(lines), encoding="utf-8")
    entry = (
        f"\nfrom .transforms.delays import {', '.join(names)}  # noqa: E402\n\n__all__ += {names}\n"
    )
    insert(entry, checkout / "torchrl/envs/__init__.py")
    for name, after in zip(
        names, ("ActionDiscretizer", "ObservationNorm", "ObservationTransform"), strict=True
    ):
        insert(
            f"    {name}\n",
            checkout / "docs/source/reference/envs_transforms.rst",
            f"    {after}\n",
        )
    shutil.copy(OWN / "test_delay_transforms.py", checkout / "test/transforms")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
