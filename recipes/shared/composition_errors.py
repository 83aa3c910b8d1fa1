"""Hydra's and OmegaConf's errors as one line that names the key, the value and the remedy."""

import difflib
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from shared.settings import CONF, LEARNERS, TrainConfig

COMPOSITION_ERRORS = (HydraException, OmegaConfBaseException, ValueError, TypeError, OSError)
"""What Hydra raises for overrides that it cannot compose."""

_schemas: list[type] = [TrainConfig]
"""Schemas whose keys are suggested for a misspelt key, the running program's first."""


def set_schema(schema: type) -> None:
    """Set the running program's schema, whose keys are suggested for a misspelt key."""
    _schemas[:] = dict.fromkeys([schema, TrainConfig])


def one_line(error: BaseException) -> str:
    """The deepest cause of an error on one line, without Hydra's lines of types, paths and hints."""
    while isinstance(error.__cause__, OmegaConfBaseException):
        error = error.__cause__
    text, _, _ = str(error).partition("Config search path")
    if re.search(r"mismatched input '='|no viable alternative at input '\[\w+='", text):
        return "a value with = in it needs quotes, such as \"overrides=['frames=1000','worlds=8']\""
    if option := re.search(r"Could not find '([\w-]+)/(\S+)'", text):
        return _no_such_option(*option.groups())
    if "Config group override must be a string" in text:
        return next(map(_not_an_option, filter(_gives_group_no_name, sys.argv[1:])), text)
    key = re.search(r"full_key: (\S+)", text)
    if key and re.search(r"Key '.*' (is )?not in ", text):
        return no_such_key(key[1])
    tails = ("full_key", "reference_type", "object_type", "Set the env")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    first, *more = [line for line in lines if not line.startswith(tails)] or [type(error).__name__]
    message = " ".join([first, ", ".join(more).replace(":,", ":")]).strip()
    return f"{key[1]}: {message}" if key else message


def _no_such_option(group: str, option: str) -> str:
    folder = Path(CONF) / group
    if not folder.is_dir():
        return no_such_key(group)
    options = sorted(str(file.relative_to(folder).with_suffix("")) for file in folder.rglob("*.yaml"))
    return f"{group}: {option} is not one of {', '.join(options)}"


def _gives_group_no_name(override: str) -> bool:
    """Does an override set a group to a number or null, which Hydra refuses without naming the group?"""
    match = re.fullmatch(r"\+?(\w+)=([\d,.]+|null)", override)
    return match is not None and (match[1] in _RENAMED or (Path(CONF) / match[1]).is_dir())


def _not_an_option(override: str) -> str:
    group, _, option = override.lstrip("+").partition("=")
    return _no_such_option(group, option)


_RENAMED = {
    "task": "reward",
    "algo": "learner",
    "mappo": "learner",
    "sac": "learner",
    "usecase": "scenario=paper/usecase1 or paper/usecase2, not usecase",
    "delaybench": "scenario=delaybench/tracking and the like, not delaybench",
    "region.situations": "region.initial_conditions",
}
"""Keys and groups of damian 0.1, and those that replaced them."""


def no_such_key(key: str) -> str:
    """The message for an unknown key, with the nearest known key."""
    if re.match(r"delay\.(obs|act|rew)\.", key):
        return f"{key}: no such key of the chosen delay law; to write another law, choose delay=none first"
    group = key.partition(".")[0]
    renamed = _RENAMED.get(key, _RENAMED.get(group))
    if renamed:
        return f"{key}: no such key; since damian 0.2 it is {renamed}"
    matches = (difflib.get_close_matches(key, _keys_of(schema), n=1, cutoff=0.75) for schema in _schemas)
    nearest = next(filter(None, matches), [])
    return f"{key}: no such key" + "".join(f"; did you mean {name}?" for name in nearest)


def _keys_of(schema: type) -> list[str]:
    """Every dotted key of a schema; of ``TrainConfig`` with the keys of every learner."""
    learners = LEARNERS.values() if schema is TrainConfig else ()
    configs = [OmegaConf.structured(schema), *(OmegaConf.create({"learner": make()}) for make in learners)]
    return list(dict.fromkeys(name for config in configs for name in _keys(config)))


def _keys(config: DictConfig, path: str = "") -> Iterator[str]:
    """Every dotted key of a configuration."""
    for name in config:
        yield f"{path}{name}"
        node = config._get_node(name)
        if isinstance(node, DictConfig) and not node._is_missing():
            yield from _keys(config[name], f"{path}{name}.")
