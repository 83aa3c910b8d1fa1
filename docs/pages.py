"""Pages of the documentation site made from the project: settings, API, examples, texts beside docs/.

MkDocs calls the functions that begin with ``on_``.
"""

import ast
import html
import json
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

import damian
from damian.recipes.command import PROGRAMS
from damian.recipes.known import SCHEMAS, Setting, default_options, groups, help_text, known_settings

ROOT = Path(__file__).parents[1]
TEXTS = {"README.md": "index.md", "RESULTS.md": "RESULTS.md", "CONTRIBUTING.md": "CONTRIBUTING.md"}
TEXTS |= {"CHANGELOG.md": "CHANGELOG.md", "CITATION.cff": "CITATION.cff", "SECURITY.md": "SECURITY.md"}
TEXTS |= {"examples/fleet/README.md": "fleet.md", "examples/fleet/docs/mavlink.md": "mavlink.md"}
"""Files beside docs/, and what they are called in the site."""
SHOWN = (*SCHEMAS,)
"""Programs whose settings have a page."""
PACKAGES = (
    "transforms",
    "delays",
    "envs",
    "replay",
    "learners",
    "server",
    "world",
    "baselines",
    "runs",
    "compare",
    "show",
    "interop",
    "field",
)
"""Packages with a page of the API, the most used first."""
PROGRAM_FUNCTIONS = {
    "load": "recipes.evaluate.load",
    "results": "recipes.results.results",
    "compose_scenario": "recipes.shared.environments.compose_scenario",
}
"""Public functions of the programs, and where they lie in a clone."""
NOTEBOOKS = sorted(ROOT.glob("docs/notebooks/*.ipynb"))


def on_config(config: Any) -> Any:
    """Add the made pages to the navigation."""
    config.nav += [
        {"Commands": ["commands/index.md", *[{f"damian {name}": f"commands/{name}.md"} for name in SHOWN]]},
        {"API": ["api/index.md", *[{f"damian.{name}": f"api/{name}.md"} for name in PACKAGES]]},
        {"Notebooks": [f"notebooks/{path.stem}.md" for path in NOTEBOOKS]},
        {"Examples": [{path: f"examples/{path}.md"} for path in examples()]},
        {"A service for fleets": ["fleet.md", "mavlink.md"]},
        {"Project": [{"Contributing": "CONTRIBUTING.md"}, {"Changes": "CHANGELOG.md"}]},
    ]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the made pages."""
    pages = {name: (ROOT / source).read_text(encoding="utf-8") for source, name in TEXTS.items()}
    pages |= {"commands/index.md": commands(), **{f"commands/{name}.md": settings(name) for name in SHOWN}}
    pages |= {"api/index.md": public_names(), **{f"api/{name}.md": package(name) for name in PACKAGES}}
    pages |= {f"examples/{path}.md": example(path) for path in examples()}
    pages |= {f"notebooks/{path.stem}.md": notebook(path) for path in NOTEBOOKS}
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead the links of the project's texts, which lead to its files, to pages of the site."""
    page_name = page.file.src_uri
    if page_name.startswith(("api/", "commands/", "examples/", "notebooks/")):
        return markdown
    files = {name: path for path, name in TEXTS.items()}
    folder = posixpath.dirname(files.get(page_name, "docs/"))

    def lead(match: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join(folder, match[2]))
        if path.startswith("examples/") and path not in TEXTS:
            return f"{match[1]}{path}.md"
        return match[1] + TEXTS.get(path, path.removeprefix("docs/"))

    return re.sub(r'(\]\(|src=")((?!https?:|#)[^)#"]+)', lead, markdown)


def commands() -> str:
    """The programs, with what each says of itself."""
    hint = "Settings are overrides of [Hydra](https://hydra.cc); `damian PROGRAM --help KEY` explains one."
    parts = ["# Commands", hint]
    for name, what in PROGRAMS.items():
        text = help_text(name)
        parts += [f"## damian {name}", f"{what[0].upper()}{what[1:]}.", f"```text\n{text}\n```"]
    return "\n\n".join(parts)


def settings(program: str) -> str:
    """The groups and settings of a program as tables, a section for each."""
    everything = known_settings(program)
    parts = [f"# Settings of damian {program}"]
    if program == "train":
        parts += ["## Groups", table(("group", "options"), group_rows(program))]
    elif "learner" in everything:
        parts.append("Those of [damian train](train.md) may be given too.")
        everything = {key: each for key, each in everything.items() if key not in known_settings("train")}
    sections: dict[str, list[tuple[str, ...]]] = {}
    for key, setting in everything.items():
        section = key.split(".")[0] if "." in key else "general"
        if not setting.is_section:
            sections.setdefault(section, []).append(row(key, setting))
    head = ("setting", "type", "default", "meaning")
    return "\n\n".join([*parts, *(f"## {name}\n\n{table(head, rows)}" for name, rows in sections.items())])


def group_rows(program: str) -> list[tuple[str, ...]]:
    """Each group of settings with its options, the default one in bold."""
    options = groups()
    return [
        (code(name), ", ".join(f"**{each}**" if each == default else each for each in options[name]))
        for name, default in default_options(program).items()
        if name in options
    ]


def row(key: str, setting: Setting) -> tuple[str, ...]:
    """A setting in a table."""
    meaning = " ".join(setting.text.replace("``", "`").split())
    return code(key), code(setting.kind), code(setting.shown), meaning.replace("|", "&#124;")


def code(text: str) -> str:
    """Text as code in a cell of a table."""
    return f"<code>{html.escape(text).replace('|', '&#124;')}</code>" if text else ""


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A Markdown table."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def public_names() -> str:
    """The names that ``import damian`` offers."""
    parts = ["# damian", "`import damian` offers these names, and loads each when it is first used.", ""]
    for name in sorted(damian._MODULE_OF):
        path = PROGRAM_FUNCTIONS.get(name, f"{getattr(damian, name).__module__}.{name}")
        parts.append(f"- [`{name}`][{path}]")
    parts += ["", *(f"::: {path}" for path in PROGRAM_FUNCTIONS.values()), "", "::: damian.keys"]
    return "\n".join(parts)


def package(name: str) -> str:
    """The API of a package, module by module."""
    folder = ROOT / "damian" / name
    paths = sorted(folder.rglob("[!_]*.py"))
    modules = [
        f"::: damian.{'.'.join(path.relative_to(ROOT / 'damian').with_suffix('').parts)}" for path in paths
    ]
    return "\n\n".join([f"# damian.{name}", docstring(folder / "__init__.py"), *modules])


def examples() -> list[str]:
    """The files of examples/, relative to it."""
    folder = ROOT / "examples"
    files = [path for kind in ("*.py", "*.yaml") for path in folder.rglob(kind)]
    own = folder / "fleet"  # a distribution of its own
    return sorted(path.relative_to(folder).as_posix() for path in files if own not in path.parents)


def example(path: str) -> str:
    """The page of an example."""
    language = "yaml" if path.endswith(".yaml") else "python"
    return f"# {path}\n\n```{language}\n{(ROOT / 'examples' / path).read_text(encoding='utf-8')}```\n"


def notebook(path: Path) -> str:
    """The page of a notebook, without the outputs."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    texts = [("".join(cell["source"]), cell["cell_type"] == "code") for cell in cells]
    link = f"[{path.name}]({path.name}) runs in Jupyter."
    parts = [f"```python\n{text}\n```" if is_code else text for text, is_code in texts]
    return "\n\n".join([parts[0], link, *parts[1:]])


def docstring(path: Path) -> str:
    """The docstring of a module."""
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
