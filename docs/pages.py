"""Pages of the documentation site made from the project: settings, API, examples, texts beside
docs/.

MkDocs calls the functions that begin with ``on_``.
"""

import ast
import base64
import html
import json
import posixpath
import re
from dataclasses import MISSING
from pathlib import Path
from typing import Any

import damian
from damian.recipes.command import PROGRAMS
from damian.recipes.known import (
    SCHEMAS,
    Setting,
    default_options,
    groups,
    help_text,
    known_settings,
)
from damian.server.features import FEATURES

ROOT = Path(__file__).parents[1]
TEXTS = {"README.md": "index.md", "RESULTS.md": "RESULTS.md", "CONTRIBUTING.md": "CONTRIBUTING.md"}
TEXTS |= {
    "CHANGELOG.md": "CHANGELOG.md",
    "CITATION.cff": "CITATION.cff",
    "SECURITY.md": "SECURITY.md",
}
TEXTS |= {
    "examples/fleet/README.md": "fleet.md",
    "examples/fleet/docs/first-flight.md": "first-flight.md",
    "examples/fleet/docs/mavlink.md": "mavlink.md",
}
CARDS = ROOT.glob("damian/data/*/README.md")
TEXTS |= {
    f"damian/data/{card.parent.name}/README.md": f"policies/{card.parent.name}.md" for card in CARDS
}
"""Files beside docs/, and what they are called in the site."""
SHOWN = (*SCHEMAS,)
"""Programs whose settings have a page."""
PACKAGES = (
    "transforms",
    "delays",
    "envs",
    "replay",
    "models",
    "learners",
    "server",
    "world",
    "baselines",
    "runs",
    "compare",
    "show",
    "interop",
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
    """Put the made pages into the navigation, in place of the folders that it names."""
    config.nav = [with_pages(each) for each in config.nav]
    return config


def with_pages(entry: Any) -> Any:
    """An entry of the navigation, in which a folder's name stands for the pages made in it."""
    if isinstance(entry, str):
        return entry
    ((title, content),) = entry.items()
    if not isinstance(content, str):
        return {title: [with_pages(each) for each in content]}
    return {title: listed(content) if content.endswith("/") else content}


def listed(folder: str) -> list[Any]:
    """The made pages in a folder, its first page unnamed, as a part of the navigation."""
    if folder == "commands/":
        return ["commands/index.md", *({f"damian {name}": f"commands/{name}.md"} for name in SHOWN)]
    if folder == "api/":
        return ["api/index.md", *({f"damian.{name}": f"api/{name}.md"} for name in PACKAGES)]
    inside = folder.removeprefix("examples/")
    names = [
        path for path in examples() if (path.startswith(inside) if inside else "/" not in path)
    ]
    return [{path.removeprefix(inside): f"examples/{path}.md"} for path in names]


def on_files(files: Any, config: Any) -> Any:
    """Add the made pages, and the pictures in the outputs of notebooks."""
    from mkdocs.structure.files import File  # noqa: PLC0415 (tests make the pages without MkDocs)

    for name, content in made().items():
        files.append(File.generated(config, name, content=content))
    return files


def made() -> dict[str, str | bytes]:
    """The pages that are not files of docs/, and pictures, by their names in the site."""
    pages: dict[str, str | bytes]
    pages = {name: (ROOT / source).read_text(encoding="utf-8") for source, name in TEXTS.items()}
    pages |= {
        "commands/index.md": commands(),
        **{f"commands/{name}.md": settings(name) for name in SHOWN},
    }
    pages |= {
        "api/index.md": public_names(),
        **{f"api/{name}.md": package(name) for name in PACKAGES},
    }
    pages |= {f"examples/{path}.md": example(path) for path in examples()} | {
        "features.md": features()
    }
    for path in NOTEBOOKS:
        pages |= notebook(path)
    return pages


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The text of a page with the links and pictures of the site."""
    return led(markdown, page.file.src_uri)


def led(markdown: str, page_name: str) -> str:
    """Lead the links of the project's texts, which lead to its files, to pages of the site; mend
    pictures."""
    if page_name.startswith(("api/", "commands/", "examples/")):
        return markdown
    markdown = re.sub(r"<img\s[^>]*>", picture, markdown)
    files = {name: path for path, name in TEXTS.items()}
    folder = posixpath.dirname(files.get(page_name, f"docs/{page_name}"))

    def lead(match: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join(folder, match[1]))
        if path.startswith("examples/") and path not in TEXTS:
            path += ".md"
        if (
            path.startswith("damian/") and path not in TEXTS
        ):  # a module; its page has a heading for it
            module = path.removesuffix(".py").replace("/", ".")
            path = f"api/{module.split('.')[1]}.md#{module}"
        site = TEXTS.get(path, path.removeprefix("docs/"))
        return f"]({posixpath.relpath(site, posixpath.dirname(page_name) or '.')}"

    return re.sub(r"\]\(((?!https?:|#)[^)#\"]+)", lead, markdown)


def picture(tag: re.Match[str]) -> str:
    """A picture in Markdown, of one in HTML: MkDocs leads only the former to where its file is."""
    given = dict(re.findall(r'(\w+)="([^"]*)"', tag[0]))
    text, width = " ".join(given["alt"].split()), given.get("width")
    return f"![{text}]({given['src']})" + f'{{ width="{width}" }}' * (width is not None)


def commands() -> str:
    """The programs, with what each says of itself."""
    hint = (
        "Settings are overrides of [Hydra](https://hydra.cc); `damian PROGRAM --help KEY` explains "
        "one."
    )
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
        everything = {
            key: each for key, each in everything.items() if key not in known_settings("train")
        }
    sections: dict[str, list[tuple[str, ...]]] = {}
    for key, setting in everything.items():
        section = key.split(".")[0] if "." in key else "general"
        if not setting.is_section:
            sections.setdefault(section, []).append(row(key, setting))
    head = ("setting", "type", "default", "meaning")
    return "\n\n".join(
        [*parts, *(f"## {name}\n\n{table(head, rows)}" for name, rows in sections.items())]
    )


def group_rows(program: str) -> list[tuple[str, ...]]:
    """Each group of settings with its options, the default one in bold."""
    options = groups()
    return [
        (
            code(name),
            ", ".join(f"**{each}**" if each == default else each for each in options[name]),
        )
        for name, default in default_options(program).items()
        if name in options
    ]


def row(key: str, setting: Setting) -> tuple[str, ...]:
    """A setting in a table."""
    meaning = " ".join(setting.text.replace("``", "`").split())
    default = "" if setting.default is MISSING else repr(setting.default)
    return code(key), code(setting.kind), code(default), meaning.replace("|", "&#124;")


def code(text: str) -> str:
    """Text as code in a cell of a table."""
    return f"<code>{html.escape(text).replace('|', '&#124;')}</code>" if text else ""


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A Markdown table."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def features() -> str:
    """The features that an observation may have, as a table."""
    head, rows = ("feature", "scope", "meaning"), []
    for name in FEATURES:
        feature = FEATURES.get(name, "")
        meaning = re.sub(r",? ?\[\*[^]]*\]", "", " ".join((feature.compute.__doc__ or "").split()))
        rows.append((code(name), feature.scope, meaning.replace("``", "`").replace("|", "&#124;")))
    text = "What settings of `observation` may name ([your own](extending.md))."
    return "\n\n".join(["# Features of an observation", text, table(head, rows)])


def public_names() -> str:
    """The names that ``import damian`` offers."""
    parts = [
        "# damian",
        "`import damian` offers these names, and loads each when it is first used.",
        "",
    ]
    for name in sorted(damian._MODULE_OF):
        path = PROGRAM_FUNCTIONS.get(name) or f"{getattr(damian, name).__module__}.{name}"
        parts.append(f"- [`{name}`][{path}]")
    parts += ["", *(f"::: {path}" for path in PROGRAM_FUNCTIONS.values()), "", "::: damian.keys"]
    return "\n".join(parts)


def package(name: str) -> str:
    """The API of a package, module by module."""
    folder = ROOT / "damian" / name
    paths = sorted(folder.rglob("[!_]*.py"))
    modules = [
        f"::: damian.{'.'.join(path.relative_to(ROOT / 'damian').with_suffix('').parts)}"
        for path in paths
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
    text = (ROOT / "examples" / path).read_text(encoding="utf-8")  # it may have fences of its own
    return f"# {path}\n\n````{language}\n{text}````\n"


def notebook(path: Path) -> dict[str, str | bytes]:
    """The page of a notebook with its outputs, and their pictures."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    parts = ["".join(cells[0]["source"]), f"[{path.name}]({path.name}) runs in Jupyter."]
    pictures: dict[str, str | bytes] = {}
    for cell in cells[1:]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        for output in cell.get("outputs", ()):
            if "text" in output:
                parts.append(f"```text\n{''.join(output['text'])}```")
            if data := output.get("data", {}).get("image/png"):
                name = f"{path.stem}_{len(pictures)}.png"
                pictures[f"notebooks/{name}"] = base64.b64decode(data)
                parts.append(f"![Output of the code above]({name})")
    return {f"notebooks/{path.stem}.md": "\n\n".join(parts), **pictures}


def docstring(path: Path) -> str:
    """The docstring of a module."""
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
