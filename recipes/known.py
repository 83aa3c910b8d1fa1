"""What can be said on a command line: the settings and options that are known, help, and hints for typos.

Nothing here imports torch or Hydra, so that help and a misspelt word are answered at once.
"""

import dataclasses
import difflib
import functools
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

import yaml

from damian.common.errors import InputError
from damian.common.fields import default_of, rules
from damian.common.text_files import read_text
from damian.compare.config import CompareConfig
from damian.learners.config import LEARNERS

from .config import AdviseConfig, ExportConfig, FlyConfig, ResultsConfig, TrainConfig

CONF = Path(__file__).parents[1] / "conf"
"""Folder of the configuration files: one for each program, and in folders one for each option of a group."""
SCHEMAS: dict[str, type] = {
    "train": TrainConfig,
    "evaluate": TrainConfig,
    "fly": FlyConfig,
    "advise": AdviseConfig,
    "compare": CompareConfig,
    "export": ExportConfig,
    "results": ResultsConfig,
}
"""Settings of the programs."""
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

# ------------------------------------------------------------------------------------------ settings


@dataclass(frozen=True)
class Setting:
    """A setting as its dataclass declares it."""

    kind: str
    """Type annotation."""
    default: Any
    """Default value; None of a section."""
    text: str
    """What the setting means, with its unit."""
    is_section: bool = False

    @property
    def shown(self) -> str:
        """The default value as text; empty of a section."""
        return "" if self.is_section or self.default is dataclasses.MISSING else repr(self.default)


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
        rule, default = rules(kind)[each.name], default_of(each)
        if rule.fixed:
            continue
        section: Any = (
            type(default) if is_dataclass(default) else each.type if is_dataclass(each.type) else None
        )
        written = str(each.type)
        named = written if "[" in written else getattr(each.type, "__name__", written)
        found[f"{path}{each.name}"] = Setting(
            named, None if section else default, rule.meaning, bool(section)
        )
        if section:
            found |= described(section, f"{path}{each.name}.")
    return found


def default_options(program: str) -> dict[str, str]:
    """The groups of a program, each with its default option; ``???`` if one must be chosen."""
    found: dict[str, str] = {}
    for each in yaml.safe_load((CONF / f"{program}.yaml").read_text(encoding="utf-8")).get("defaults", []):
        if isinstance(each, dict):
            found |= {group: option for group, option in each.items() if " " not in group}
        elif (CONF / f"{each}.yaml").is_file():
            found |= default_options(each)
    return found


def groups() -> dict[str, list[str]]:
    """Options of every group, by the group's name; a file _NAME.yaml is what options share."""
    options: dict[str, list[str]] = {}
    for file in sorted(CONF.rglob("[!_]*.yaml")):
        group, *rest = file.relative_to(CONF).with_suffix("").parts
        if rest:
            options.setdefault(group, []).append("/".join(rest))
    return options


# ------------------------------------------------------------------------------------------ hints


def key_of(word: str) -> str:
    """The key or group that a word sets."""
    return word.lstrip("+~").partition("=")[0]


def check_words(program: str, words: Iterable[str]) -> None:
    """Refuse unknown keys and options, as far as the words alone can tell, without any slow import."""
    options = groups()
    for word in words:
        key, _, value = word.partition("=")
        if key in options:
            names = [name for name in value.split(",") if re.fullmatch(r"[\w/.-]+", name)]
            if key == "delay" and re.match(r"-?\d", value):
                raise InputError(f"delay: {value} is not an option of this group; write delay.obs={value}")
            if wrong := [name for name in names if name not in (*options[key], "null")]:
                raise InputError(f"{key}: {wrong[0]} is not one of {', '.join(options[key])}")
        elif not (is_known(key, program) or key.startswith(("hydra", "+", "~", "-"))):
            raise InputError(no_such_key(key, program))


def without(words: Sequence[str], replaced: Collection[str]) -> list[str]:
    """The words but those that set one of these keys and groups, or a key below them."""
    return [w for w in words if not any(f"{key_of(w)}.".startswith(f"{key}.") for key in replaced)]


def is_known(key: str, program: str) -> bool:
    """Is a key that of a setting, or below one that holds anything, or of a learner of the user's own?"""
    known, parts = known_settings(program), key.partition("@")[0].split(".")
    above = [known.get(".".join(parts[:n])) for n in range(1, len(parts))]
    is_open = any(each and each.kind.startswith(("Any", "list", "dict")) for each in above)
    return key in known or is_open or parts[0] == "learner"


def no_such_key(key: str, program: str) -> str:
    """The message for an unknown key, with the nearest known one."""
    if key in SYNONYMS:
        return f"{key}: unknown setting; did you mean {SYNONYMS[key]}?"
    if program == "compare" and (key in known_settings("train") or key in default_options("train")):
        return f"{key}: it is a setting of the runs; all of them get it by \"overrides=['{key}=...']\""
    names = [*known_settings(program), *default_options(program)]
    near = difflib.get_close_matches(key, names, n=1, cutoff=0.7)
    near = near or [name for name in names if name.rpartition(".")[2] == key][:1]
    return f"{key}: unknown setting" + "".join(f"; did you mean {name}?" for name in near)


# ------------------------------------------------------------------------------------------ help

DELAYS = """\
  delay.obs=3 (steps) | 3s | 1..7 (uniform) | 3s..7s | "{law: geometric, mean: 2s}"   delay.act=..."""
POLICY = "  changed settings of the run: agents=5 delay=paper delay.obs=6; what is not mentioned stays\n"
SWEEP = "  hydra.run.dir=FOLDER   --config-dir FOLDER (options of your own)   -m seed=0,1,2 (a sweep)"
HINTS = {
    "train": "agents=3 seed=0 frames=300000 worlds=64 device=cuda compile=true learner.lr=3e-4\n"
    f"{DELAYS}\n  resume=FOLDER (go on with a run)   checkpoint=FOLDER (begin with its policy)\n{SWEEP}",
    "evaluate": f"checkpoint=FOLDER eval_episodes=200\n{POLICY}{DELAYS}\n{SWEEP}, of checkpoint=A,B too",
    "fly": 'checkpoint=FOLDER policy=deterministic "formats=[gif,png,html]" "views=[2d,3d]" keep=extremes\n'
    f'{POLICY}{DELAYS}\n  "replay=[A.json,B.json]" (stored episodes in one page)\n{SWEEP}',
    "compare": "experiment=delaybench seeds=10 processes=2 (the same command continues a comparison)\n"
    '  "tasks=[crowded]" "delays=[paper]" "arms=[undelayed,naive]" "overrides=[\'frames=100000\']"\n'
    "  report_only=true (tables of what is stored)   keep=true (without the folders of finished runs)\n"
    "  hydra.run.dir=FOLDER   --config-dir FOLDER (experiments of your own)",
    "advise": f"checkpoint=FOLDER table=REPORTS.csv (or fit=JOURNAL: its delays as a trace)\n{POLICY}{SWEEP}",
    "export": "checkpoint=FOLDER, or just FOLDER",
    "results": 'FOLDER, or two folders to compare; "folders=[A,B]" score=steps',
}
"""What is often written with each program."""
MEANING = """\
Meaning, type, default and unit: damian {name} --help KEY | GROUP ...
All settings with your words, before any training: damian {name} ... --cfg job"""


def help_text(name: str, keys: Sequence[str] = ()) -> str:
    """What ``--help`` prints: a page on a program, or the meaning of settings and groups."""
    if keys:
        found = [[*_options(name, key), *_meaning(name, key)] for key in keys]
        return "\n".join("\n".join(f or [no_such_key(k, name)]) for k, f in zip(keys, found, strict=True))
    lines = [f"damian {name} [GROUP=OPTION] [KEY=VALUE] ...", "", f"Often used: {HINTS[name]}"]
    known, common = known_settings(name), {} if name in ("train", "compare") else known_settings("train")
    own = [key for key in known if key not in common and not known[key].is_section and "." not in key]
    if name != "train":
        lines += ["", "Its own settings:", *_meaning(name, *(own or ("checkpoint", "eval_episodes")))]
    lines += ["", "Groups (the default in brackets):"] if default_options(name) else []
    for group, default in default_options(name).items():
        options = [f"[{o}]" if o == default else o for o in groups().get(group, [])]
        lines.append(f"  {group:10} {'   '.join(options)}")
    return "\n".join([*lines, "", MEANING.format(name=name)])


def _options(program: str, group: str) -> list[str]:
    """How to choose an option of a group, with what the comment at the top of its file says; or nothing."""
    if group not in default_options(program):
        return []
    default, lines = default_options(program)[group], [f"choose one with {group}=OPTION:"]
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
            default = f" = {each.shown}" if each.shown else ""
            lines += [f"{name}: {each.kind}{default}", *([f"    {each.text}"] if each.text else [])]
    return lines
