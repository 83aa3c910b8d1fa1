"""What can be said on a command line: its words, the known keys and options, help, and hints for typos.

Nothing here imports torch or Hydra, so that help and a misspelt word are answered at once.
"""

import dataclasses
import difflib
import functools
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, NoReturn

import yaml

from damian.common.errors import InputError
from damian.common.fields import default_of, rules
from damian.common.text_files import read_text, show
from damian.compare.config import CompareConfig
from damian.learners.config import LEARNERS

from .config import AdviseConfig, FlyConfig, TrainConfig, TuneConfig

CONF = Path(__file__).parents[1] / "conf"
"""Folder of the configuration files."""
SCHEMAS: dict[str, type] = {
    "train": TrainConfig,
    "fly": FlyConfig,
    "tune": TuneConfig,
    "advise": AdviseConfig,
    "compare": CompareConfig,
}
"""Settings of the programs."""
FILELESS = ("train", "fly", "advise")
"""Programs that need no file in conf/ beside defaults.yaml."""
CHOSEN = ("region", "motion", "source", "battery", "links", "learner")
"""Sections whose keys depend on the option that is chosen."""
PLAIN = {
    "region": ["random", "vertices", "fir", "geojson"],
    "motion": ["instant"],
    "source": ["static", "dynamic"],
    "battery": ["none", "charging"],
    "links": ["server", "updown", "matrix"],
    "actions": ["discrete", "continuous"],
    "learner": [*LEARNERS],
    "model": ["mlp"],
    "logger": ["all", "csv", "tensorboard", "wandb"],
    "delay": ["none"],
    "aware": ["none"],
}
"""Options of the groups that need no file, because they only choose a kind."""
OWN = ("region", "motion", "learner")
"""Groups in which an option may also be the path of the user's own, ``package.module:Name``."""
SYNONYMS = {
    "learning_rate": "learner.lr",
    "belief": "aware=belief",
    "latency": "delay.obs",
    "num_envs": "worlds",
    "n_envs": "worlds",
    "total_frames": "frames",
    "total_timesteps": "frames",
    "timesteps": "frames",
    "uavs": "agents",
    "algo": "learner",
    "algorithm": "learner",
    "task": "scenario",
    "env": "scenario",
    "gpu": "device",
    "cuda": "device",
}
"""What people type who know other programs, and what it is called here."""


# ------------------------------------------------------------------------------------------ words


class Parser(ArgumentParser):
    """Raises an ``InputError`` instead of printing its usage."""

    def error(self, message: str) -> NoReturn:
        raise InputError(message)


def parsed(words: Sequence[str]) -> Namespace:
    """The options and the ``overrides`` of a command line; options may stand anywhere."""
    parser = Parser(add_help=False, allow_abbrev=False)
    parser.add_argument("-h", "--help", action="store_true")
    parser.add_argument("-m", "--multirun", action="store_true")
    parser.add_argument("-cd", "--config-dir")
    parser.add_argument("--cfg", choices=["job"])
    parser.add_argument("overrides", nargs="*")
    given = parser.parse_intermixed_args(list(words))
    if given.config_dir and not Path(given.config_dir).is_dir():
        raise InputError(f"--config-dir: {show(given.config_dir)} is not a folder")
    return given


def key_of(word: str) -> str:
    """The key or group that an override sets."""
    return word.lstrip("+~").partition("=")[0]


def whole_laws(words: Sequence[str]) -> list[str]:
    """The words with a number before each delay law, because Hydra would merge it with the law before it."""
    laws = ("delay.obs={", "delay.act={", "delay.rew={")
    return [new for word in words for new in ([f"{key_of(word)}=0"] * word.startswith(laws) + [word])]


def check_words(program: str, words: Sequence[str], own_folder: str | None = None) -> None:
    """Refuse unknown keys and options, as far as a look at the words can tell; the schemas tell the rest."""
    known, options = known_settings(program), groups(own_folder)
    for word in words:
        key, equals, value = word.partition("=")
        parts = value.split(",")  # of a sweep
        if not equals and not word.startswith("~"):
            raise InputError(f"{show(word)}: this word is not of the form KEY=VALUE")
        if key in options:
            if key == "delay" and value[:1].isdigit():
                raise InputError(f"delay: {value} is not an option of this group; write delay.obs={value}")
            names = [part for part in parts if part.replace("/", "").isidentifier()]
            if wrong := [name for name in names if name not in (*options[key], "null")]:
                raise InputError(f"{key}: {wrong[0]} is not one of {', '.join(options[key])}")
        elif not (is_known(key, known) or own_folder or key.startswith(("hydra", "+", "~"))):
            raise InputError(no_such_key(key, program))


def is_known(key: str, known: "dict[str, Setting]") -> bool:
    """Is a key that of a setting, or below one that holds anything, or of a learner of the user's own?"""
    parts = key.partition("@")[0].split(".")
    above = [known.get(".".join(parts[:n])) for n in range(1, len(parts))]
    is_open = any(each and each.kind.startswith(("Any", "list", "dict")) for each in above)
    return key in known or is_open or parts[0] == "learner"


# ------------------------------------------------------------------------------------------ settings


@dataclass(frozen=True)
class Setting:
    """A setting as its dataclass declares it."""

    kind: str
    """Type annotation."""
    default: str
    """Default value as text; empty for a section."""
    text: str
    """What the setting means, with its unit."""


@functools.cache
def known_settings(program: str) -> dict[str, Setting]:
    """Every setting of a program by its dotted key, sections included; those of every learner."""
    found = _described(SCHEMAS[program], "")
    if "learner" in found:
        for name in LEARNERS:
            found = {**_described(LEARNERS.get(name, "learner"), "learner."), **found}
    return found


def _described(kind: type, path: str) -> dict[str, Setting]:
    found: dict[str, Setting] = {}
    every = rules(kind)
    for each in fields(kind):
        rule, default = every[each.name], default_of(each)
        if rule.fixed:
            continue
        # Such as an experiment, which must be chosen.
        chosen: Any = each.type if is_dataclass(each.type) else None
        section: Any = type(default) if is_dataclass(default) else chosen
        text = "" if section or default is dataclasses.MISSING else f"{default!r}"
        written = str(each.type)
        named = written if "[" in written else getattr(each.type, "__name__", written)
        found[f"{path}{each.name}"] = Setting(named, text, rule.meaning)
        if section:
            found |= _described(section, f"{path}{each.name}.")
    return found


@functools.cache
def default_options(program: str) -> dict[str, str]:
    """The groups of a program, each with its default option; ``???`` if one must be chosen."""
    if program in FILELESS:
        return default_options("defaults")
    found: dict[str, str] = {}
    for each in yaml.safe_load((CONF / f"{program}.yaml").read_text(encoding="utf-8"))["defaults"]:
        if each == "defaults":
            found |= default_options("defaults")
        elif not isinstance(each, str):
            (group, option), *_ = each.items()
            found |= {} if " " in group else {group: option}
    return found


def groups(own_folder: str | None = None) -> dict[str, list[str]]:
    """Options of every group, by the group's name; a file _NAME.yaml is what options share."""
    options: dict[str, list[str]] = {}
    for root in map(Path, filter(None, [own_folder, CONF])):
        for file in sorted(root.rglob("[!_]*.yaml")):
            group, *rest = file.relative_to(root).with_suffix("").parts
            if rest:
                options.setdefault(group, []).append("/".join(rest))
    return {g: [*options.get(g, []), *PLAIN.get(g, [])] for g in dict.fromkeys([*options, *PLAIN])}


def no_such_key(
    key: str, program: str = "train", section: Sequence[str] = (), option: str | None = None
) -> str:
    """The message for an unknown key, with the nearest known one; ``option`` is that of its group."""
    if key in SYNONYMS:
        return f"{key}: unknown setting; did you mean {SYNONYMS[key]}?"
    known, group = known_settings(program), key.partition(".")[0]
    if key in known and group in CHOSEN:
        return f"{key}: unknown setting for {group}={option or 'none'}; another {group}=OPTION has it"
    if program == "compare" and (key in known_settings("train") or key in default_options("train")):
        return f"{key}: it is a setting of the runs; all of them get it by \"overrides=['{key}=...']\""
    names = [*section, *known, *default_options(program)]
    near = difflib.get_close_matches(key, names, n=1, cutoff=0.7)
    near = near or [name for name in names if name.rpartition(".")[2] == key][:1]
    return f"{key}: unknown setting" + "".join(f"; did you mean {name}?" for name in near)


# ------------------------------------------------------------------------------------------ help


def help_text(name: str, program: str, keys: Sequence[str] = (), own_folder: str | None = None) -> str:
    """What ``--help`` prints: a page on a program, or the meaning of settings and groups."""
    if keys:
        found = [[*_options(program, key, own_folder), *_meaning(program, key)] for key in keys]
        return "\n".join("\n".join(f or [no_such_key(k, program)]) for k, f in zip(keys, found, strict=True))
    lines = [f"damian {name} [GROUP=OPTION] [KEY=VALUE] ...", "", "Groups (the default in brackets):"]
    for group, default in default_options(program).items():
        options = [f"[{o}]" if o == default else o for o in groups(own_folder).get(group, [])]
        lines.append(f"  {group:10} {'   '.join(options)}")
    return "\n".join([*lines, "", HINTS.format(name=name)])


HINTS = """\
Often used: agents=3 seed=0 frames=300000 worlds=64 device=cuda compile=true learner.lr=3e-4
  delay.obs=3 (steps) | 3s | "delay.obs={{law: uniform, low: 3s, high: 7s}}"   delay.act=   delay.loss=
  resume=FOLDER   checkpoint=FOLDER   hydra.run.dir=FOLDER   -m seed=0,1,2 (a sweep)   --config-dir FOLDER
Meaning, type, default and unit: damian {name} --help KEY | GROUP ...
All settings with your words, and the defaults of your learner and scenario: damian {name} ... --cfg job"""


def _options(program: str, group: str, own_folder: str | None) -> list[str]:
    """How to choose an option of a group, with what the comment at the top of its file says; or nothing."""
    if group not in default_options(program):
        return []
    default, lines = default_options(program)[group], [f"choose one with {group}=OPTION:"]
    for option in groups(own_folder)[group]:
        files = (Path(root, group, f"{option}.yaml") for root in filter(None, (own_folder, CONF)))
        text = next((read_text(file) for file in files if file.is_file()), "")
        comments = takewhile(lambda line: line.startswith("#"), text.splitlines())
        said = " ".join(line.lstrip("# ") for line in comments if "@package" not in line)
        lines.append(f"    {f'[{option}]' if option == default else option}: {said}".rstrip(": "))
    return lines


def _meaning(program: str, key: str) -> list[str]:
    """Key, type, default and meaning of a setting, or of all settings of a section."""
    lines = []
    for name, each in known_settings(program).items():
        if name == key or name.startswith(f"{key}."):
            default = f" = {each.default}" if each.default else ""
            lines += [f"{name}: {each.kind}{default}", *([f"    {each.text}"] if each.text else [])]
    return lines
