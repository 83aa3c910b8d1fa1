"""What can be said on a command line: the settings and options that are known, help, and hints for
typos.

Nothing here imports torch or Hydra, so that help and a misspelt word are answered at once.
"""

import ast
import difflib
import functools
import re
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, fields, is_dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from damian.common.errors import InputError
from damian.common.fields import default_of, rules
from damian.common.text_files import data_file, read_text
from damian.compare.config import CompareConfig
from damian.learners.config import LEARNERS

from .config import EvaluateConfig, ExportConfig, FitConfig, FlyConfig, ResultsConfig, TrainConfig

CONF = Path(__file__).parents[1] / "conf"
"""Folder of the configuration files: one for each program, and in folders one for each option of a
group."""
SCHEMAS: dict[str, type] = {
    "train": TrainConfig,
    "evaluate": EvaluateConfig,
    "fly": FlyConfig,
    "compare": CompareConfig,
    "fit": FitConfig,
    "export": ExportConfig,
    "results": ResultsConfig,
}
"""Settings of the programs."""
SYNONYMS = {
    "learning_rate": "learner.lr",
    "num_envs": "worlds",
    "total_frames": "frames",
    "total_timesteps": "frames",
    "algorithm": "learner",
    "task": "scenario",
    "env": "scenario",
}
"""What people type who know other programs, and what it is called here."""


def about(program: str) -> str:
    """What the module of a program says of it, which is not imported for that."""
    file = Path(__file__).with_name(f"{program}.py")
    return ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""


PROGRAMS = {name: about(name).partition("\n")[0] for name in SCHEMAS}
"""What each program does, by its name."""


class Setting(NamedTuple):
    """A setting as its dataclass declares it."""

    kind: str
    """Type annotation."""
    default: Any
    """Default value; None of a section."""
    text: str
    """What the setting means, with its unit."""
    is_section: bool


@functools.cache
def known_settings(program: str) -> dict[str, Setting]:
    """Every setting of a program by its dotted key, sections included; those of every learner."""
    found = described(SCHEMAS[program])
    if "learner" in found:
        for name in LEARNERS:
            found = {**described(LEARNERS.get(name, "learner"), "learner."), **found}
    return found


def described(kind: type, path: str = "") -> dict[str, Setting]:
    """Every setting of a dataclass by its dotted key, sections included."""
    found: dict[str, Setting] = {}
    for each in fields(kind):
        rule = rules(kind)[each.name]
        default = default_of(each)
        declared = each.type
        section: Any = next((x for x in (type(default), declared) if is_dataclass(x)), None)
        if not rule.fixed:
            named = (
                str(declared)
                if "[" in str(declared)
                else getattr(declared, "__name__", str(declared))
            )
            value = None if section else default
            found[f"{path}{each.name}"] = Setting(named, value, rule.meaning, section is not None)
            found |= described(section, f"{path}{each.name}.") if section else {}
    return found


def default_options(program: str) -> dict[str, str]:
    """The groups of a program, each with its default option; ``???`` if one must be chosen."""
    found = {}
    for each in yaml.safe_load((CONF / f"{program}.yaml").read_text(encoding="utf-8")).get(
        "defaults", []
    ):
        if isinstance(each, dict):
            found |= {group: option for group, option in each.items() if " " not in group}
        elif (CONF / f"{each}.yaml").is_file():
            found |= default_options(each)
    return found


def groups() -> dict[str, list[str]]:
    """Options of every group, by the group's name; a file _NAME.yaml is what options share."""
    options = {}
    for file in sorted(CONF.rglob("[!_]*.yaml")):
        group, *rest = file.relative_to(CONF).with_suffix("").parts
        if rest:
            options.setdefault(group, []).append("/".join(rest))
    return options


def key_of(word: str) -> str:
    """The key or group that a word sets."""
    return word.lstrip("+~").partition("=")[0]


MAPS = (".geojson", ".json", ".kml", ".kmz", ".gpkg", ".shp", ".plan")
"""Endings of files that ``region`` may name, in the place of an option."""


def check_words(program: str, words: Iterable[str]) -> None:
    """Refuse unknown keys and options, as far as the words alone can tell, without any slow
    import."""
    options = groups()
    for word in words:
        key, _, value = word.partition("=")
        if key in options:
            names = [name for name in value.split(",") if re.fullmatch(r"[\w/.-]+", name)]
            if key == "region":
                names = [name for name in names if not name.endswith(MAPS)]
            if key == "delay" and re.match(r"-?\d", value):
                raise InputError(
                    f"delay: {value} is not an option of this group; write delay.obs={value}"
                )
            if wrong := [name for name in names if name not in (*options[key], "null")]:
                raise InputError(f"{key}: {wrong[0]} is not one of {', '.join(options[key])}")
        elif not (is_known(key, program) or key.startswith(("hydra", "+", "~", "-"))):
            raise InputError(no_such_key(key, program))
        elif key == "checkpoint" and re.fullmatch(r"(?!null$)(damian:)?[\w.-]+", value):
            shipped = value if Path(data_file(value, key)).exists() else f"damian:{value}"
            data_file(shipped, f"{key}: {value} holds no config.yaml")  # names the package's own


def is_known(key: str, program: str) -> bool:
    """Is a key that of a setting, or below one that holds anything, or of a learner or model of the
    user's own?"""
    known = known_settings(program)
    parts = key.partition("@")[0].split(".")
    above = [known.get(".".join(parts[:n])) for n in range(1, len(parts))]
    is_open = any(each and each.kind.startswith(("Any", "list", "dict")) for each in above)
    return key in known or is_open or parts[0] in ("learner", "model")


def no_such_key(key: str, program: str) -> str:
    """The message for an unknown key, with the nearest known one."""
    if key in SYNONYMS:
        return f"{key}: unknown setting; did you mean {SYNONYMS[key]}?"
    if program == "compare" and (key in known_settings("train") or key in default_options("train")):
        return (
            f"{key}: it is a setting of the runs; all of them get it by \"overrides=['{key}=...']\""
        )
    names = [*known_settings(program), *default_options(program)]
    near = difflib.get_close_matches(key, names, n=1, cutoff=0.7)
    near = near or [name for name in names if name.rpartition(".")[2] == key][:1]
    return f"{key}: unknown setting" + "".join(f"; did you mean {name}?" for name in near)


MEANING = """\
Meaning, type, default and unit: damian {name} --help KEY | GROUP ...
All settings with your words, before any training: damian {name} ... --cfg job"""


def help_text(name: str, keys: Sequence[str] = ()) -> str:
    """What ``--help`` prints: a page on a program, or the meaning of settings and groups."""
    if keys:
        found = [[*_options(name, key), *_meaning(name, key)] for key in keys]
        return "\n".join(
            "\n".join(f or [no_such_key(k, name)]) for k, f in zip(keys, found, strict=True)
        )
    lines = [f"damian {name} [GROUP=OPTION] [KEY=VALUE] ...", "", about(name)]
    known = known_settings(name)
    common = {} if name in ("train", "compare") else known_settings("train")
    own = [
        key for key in known if key not in common and not known[key].is_section and "." not in key
    ]
    if name != "train":
        lines += [
            "",
            "Its own settings:",
            *_meaning(name, *(own or ("checkpoint", "eval_episodes"))),
        ]
    lines += ["", "Groups (the default in brackets):"] if default_options(name) else []
    for group, default in default_options(name).items():
        options = [f"[{o}]" if o == default else o for o in groups().get(group, [])]
        lines.append(f"  {group:10} {'   '.join(options)}")
    return "\n".join([*lines, "", MEANING.format(name=name)])


def _options(program: str, group: str) -> list[str]:
    """How to choose an option of a group, with what the comment at the top of its file says; or
    nothing."""
    if group not in default_options(program):
        return []
    default = default_options(program)[group]
    lines = [f"choose one with {group}=OPTION:"]
    for option in groups()[group]:
        text = read_text(CONF / group / f"{option}.yaml")
        comments = takewhile(lambda line: line.startswith("#"), text.splitlines())
        said = " ".join(line.lstrip("# ") for line in comments if "@package" not in line)
        lines.append(f"    {f'[{option}]' if option == default else option}: {said}".rstrip(": "))
    return lines


def _meaning(program: str, *keys: str) -> list[str]:
    """Key, type, default and meaning of settings, or of all settings of sections."""
    lines = []
    for name, each in known_settings(program).items():
        if any(name == key or name.startswith(f"{key}.") for key in keys):
            default = "" if each.is_section or each.default is MISSING else f" = {each.default!r}"
            lines += [f"{name}: {each.kind}{default}", *([f"    {each.text}"] if each.text else [])]
    return lines
