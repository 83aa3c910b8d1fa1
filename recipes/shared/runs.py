"""Runs in their folders: starting and resuming them, and taking settings and policy of a stored one."""

import random
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from damian.common.atomic_files import remove_unfinished, write_atomically
from damian.common.errors import InputError
from damian.common.text_files import show
from damian.runs.checkpoint import digest
from damian.runs.run_folder import CONFIG
from damian.runs.run_record import check_version, read_record, timed, write_record
from damian.runs.training_state import checkpoint_file
from damian.settings import LEARNERS, PredictiveMappoConfig, ScenarioConfig, TrainConfig
from damian.settings.fields import leaves

from ..cli import Work, checked, command, composed, reason, shown
from ..known import LOGGERS, SCHEMAS, check_words, key_of
from .settings import check_components

OVERRIDES = "overrides"
"""Entry of a run's record: the words of its command line, which programs that fly its policy apply too."""
POLICY = "policy_sha256"
"""Entry of a run that begins with a stored policy: the SHA-256 of its checkpoint."""


# ------------------------------------------------------------------------------------------ starting


def prepared(
    program: str,
    given: DictConfig,
    words: Sequence[str],
    own_folder: str | None,
    folder: Path,
    again: bool = False,
) -> tuple[Any, Path]:
    """Check the composed settings of a run and choose its folder; a resumed run keeps its stored settings."""
    words = [word for word in words if not key_of(word).startswith("hydra")]
    if program == "compare":
        config = checked(given, program)
        config.own_folder = own_folder
        return config, folder
    if given.resume is not None and program == "train":
        folder = shown(Path(given.resume))
        return resumed(folder, given, words), folder
    if (folder / CONFIG).exists():
        remedy = f"choose another folder, or continue the run with resume={folder}"
        raise InputError(f"hydra.run.dir: {folder} holds a run already; {remedy}")
    if given.checkpoint is None or again:
        config, overrides = checked(given, program), list(words)
    else:
        config, overrides = with_policy_of(given, program, words, own_folder)
    config.overrides = overrides
    check_components(config)
    return config, folder


def with_policy_of(
    given: DictConfig, program: str, words: list[str], own_folder: str | None
) -> tuple[Any, list[str]]:
    """The settings and overrides of a run that flies, or begins with, the policy of a stored run."""
    folder, trust = run_folder(Path(given.checkpoint)), bool(given.trust)
    stored, run_words = stored_config(folder, "checkpoint", trust, words), read_record(folder).get(OVERRIDES)
    before = [w for w in map(str, run_words or []) if key_of(w) not in ("trust", "checkpoint", "resume")]
    # Hydra imports a learner, and reads files that may name one, while it composes.
    named = [word.partition("=")[2].strip("'\"") for word in before]
    require_trust(named, "checkpoint", trust, words)
    defaults = {each.name: each.default for each in fields(TrainConfig)}
    others = [f.name for f in fields(SCHEMAS[program]) if f.default != defaults.get(f.name, f.default)]
    overrides = inherited(stored, before, words, others)
    check_words(program, overrides, own_folder)
    found = composed(program, overrides, own_folder)
    require_trust(found, "checkpoint", trust, words)
    config = checked(found, program)
    check_policy_fits(config, stored)
    if changed := changes(config, stored):
        print(f"changed since the training: {changed}")
    return config, overrides


def perform(config: TrainConfig, folder: Path, work: Work) -> None:
    """Do the work of a program in one thread with the seed of its settings."""
    torch.set_num_threads(1)
    seed_generators(config.seed)
    remove_unfinished(folder)
    with timed(folder):
        work(config, folder)
    print(f"results: {folder}")


def seed_generators(seed: int) -> None:
    """Seed the global random generators of torch, NumPy and Python; your own components may use each."""
    for set_seed in (torch.manual_seed, np.random.seed, random.seed):
        set_seed(seed)


def save_config(config: TrainConfig, folder: Path) -> None:
    """Write the record of words, versions and machine into the run folder, then the settings."""
    is_gpu = config.device.startswith("cuda")
    device = torch.cuda.get_device_name(config.device) if is_gpu else config.device
    entries = {OVERRIDES: list(config.overrides), "device": device, "threads": config.threads}
    if config.checkpoint and not config.resume:  # a resumed run no longer needs that policy
        entries[POLICY] = digest(checkpoint_file(Path(config.checkpoint), "checkpoint"))
    write_record(folder, command(), **entries)
    nested = OmegaConf.create()
    for key, value in leaves(config):
        OmegaConf.update(nested, key, value, force_add=True)
    write_atomically(folder / CONFIG, OmegaConf.to_yaml(nested))


# ------------------------------------------------------------------------------------------ stored runs


def run_folder(written: Path) -> Path:
    """The run folder that a folder, or a checkpoint file in it, stands for."""
    return written.parent if written.is_file() else written


def stored_config(folder: Path, key: str, trust: bool = False, named: Sequence[str] = ()) -> TrainConfig:
    """The settings of the run in a folder; the other arguments are those of ``require_trust``."""
    file = folder / CONFIG
    if not file.is_file():
        raise InputError(f"{key}: {folder} holds no {CONFIG}, so there is no run")
    check_version(folder, key)
    try:
        saved = cast(DictConfig, OmegaConf.load(file))
        require_trust(saved, key, trust, named)
        for name in sorted({*map(str, saved)} - {each.name for each in fields(TrainConfig)}):
            raise InputError(f"{name} is no setting of damian train: no policy was trained there")
        learner = LEARNERS.get(saved.learner.name, "learner")(name=saved.learner.name)
        config = OmegaConf.merge(OmegaConf.structured(TrainConfig(learner=learner)), saved)
        return cast(TrainConfig, OmegaConf.to_object(config))
    except InputError as error:
        raise InputError(str(error) if str(error).startswith(key) else f"{key}: {file}: {error}") from None
    except Exception as error:  # a damaged file can raise anything
        raise InputError(f"{key}: {file}: {reason(error)}") from None


def require_trust(found: Any, key: str, trust: bool, named: Sequence[str]) -> None:
    """Refuse components of other code that stored settings name, unless the caller has named or trusts them.

    Importing ``package.module:Name`` runs the module, and a stored file may come from anybody. So nothing is
    made of ``found``, the stored settings, before. ``key`` is the setting that names them, and ``named`` are
    the words of the command line.
    """
    typed = " ".join(named)
    foreign = [path for path in _components(found) if path not in typed]
    if foreign and not trust:
        raise InputError(
            f"{key}: its settings name {foreign[0]}, which is no part of DAMIAN; trust=true imports its code"
        )


def _components(node: Any) -> Iterator[str]:
    """Every text ``package.module:Name`` in settings, but for DAMIAN's own."""
    if isinstance(node, DictConfig | Mapping):
        for key in node:
            if key not in ("hydra", "where", "device"):  # where=PROPERTY:VALUE, device=cuda:0
                yield from _components(node[key])
    elif isinstance(node, str):
        module, colon, last = node.partition(":")
        path = all(part.isidentifier() for part in (*module.split("."), last))
        if colon and path and node not in LOGGERS.values():
            yield node
    elif isinstance(node, Sequence):
        for each in node:
            yield from _components(each)


def names_own_code(config: TrainConfig) -> bool:
    """Do the settings name components of your own, which a program imports only with ``trust=true``?"""
    return any(_components(asdict(config)))


def resumed(folder: Path, given: DictConfig, words: Sequence[str]) -> TrainConfig:
    """The settings of a run to resume; only ``frames`` and ``episodes`` may change."""
    allowed = ("resume", "frames", "episodes", "trust")
    if refused := [word for word in words if key_of(word) not in allowed]:
        problem = "a resumed run keeps its configuration; only frames= and episodes= may change; checkpoint="
        problem += f"{folder} {refused[0]} begins a new run with its policy"
        raise InputError(f"{refused[0]}: {problem}")
    config = stored_config(folder, "resume", given.trust, words)
    checkpoint_file(folder, "resume")
    config.resume = str(folder)
    for key in {"frames", "episodes"} & set(map(key_of, words)):
        setattr(config, key, given[key])
    config.__post_init__()
    check_components(config)
    return config


# ------------------------------------------------------------------------------------------ flying


def inherited(
    stored: TrainConfig, before: Sequence[str], given: Sequence[str], own: Collection[str] = ()
) -> list[str]:
    """The given overrides after those of a stored run, which keeps the histories that its policy observes."""
    keys = [*map(key_of, given), *own]
    history = [] if {"delay.history", "aware"} & {*keys} else [f"delay.history={stored.delay.history}"]
    messages = stored.delay.messages
    history += [f"delay.messages={messages}"] if messages and "delay.messages" not in keys else []
    return [*without(before, [*keys, *map(key_of, history)]), *history, *given]


def without(overrides: Sequence[str], replaced: Collection[str]) -> list[str]:
    """The overrides but those that set one of these keys and groups, or a key below them."""
    return [w for w in overrides if not any(f"{key_of(w)}.".startswith(f"{key}.") for key in replaced)]


def check_policy_fits(config: TrainConfig, stored: TrainConfig) -> None:
    """Check that a policy has the same observations, actions and layers in another scenario."""
    new, old = _shape(config), _shape(stored)
    for key, value in new.items():
        if value != old[key]:
            trained, asked = show(old[key]), show(value)
            raise InputError(f"{key}: the policy was trained with {trained}, so it cannot fly with {asked}")


def any_number_of_uavs(config: TrainConfig) -> bool:
    """Do the layers of a policy's networks have the same sizes for any number of UAVs?"""
    # An actor with a learnt belief predicts the critic's observation, so that its layers depend on it too.
    predicts = isinstance(config.learner, PredictiveMappoConfig)
    return "agent_distances" not in (config.observation.critic if predicts else config.observation.actor)


def _shape(config: TrainConfig) -> dict[str, Any]:
    """What the sizes of a policy's networks follow from, by setting."""
    observation, actions, model = config.observation, config.actions, config.model
    discrete, predicts = actions.kind == "discrete", isinstance(config.learner, PredictiveMappoConfig)
    return {
        "learner=predictive_mappo": predicts,
        "observation.ctde": observation.ctde,
        "observation.local_features": [*observation.local_features],
        "observation.global_features": [*observation.global_features] * (predicts or not observation.ctde),
        "observation.belief": [*observation.belief],
        # After the features, from which it follows: a policy with other features does not lack UAVs.
        "agents": "any number of UAVs" if any_number_of_uavs(config) else config.agents,
        "observation.age": observation.age,
        "delay.history": config.delay.history,
        "delay.messages": config.delay.messages,
        "actions.kind": actions.kind,
        "number of actions.distances": discrete and len(actions.distances),
        "number of actions.headings": discrete and len(actions.headings),
        **{f"model.{each.name}": getattr(model, each.name) for each in fields(model)},
    }


def changes(config: TrainConfig, stored: TrainConfig) -> str:
    """The settings of the scenario that differ between a stored run and a new one, on one line."""
    names = {each.name for each in fields(ScenarioConfig)}
    old, new = ({k: v for k, v in leaves(each) if k.split(".")[0] in names} for each in (stored, config))
    differ = [key for key in new if key not in old or old[key] != new[key]]
    return ", ".join(f"{key}: {show(old.get(key, 'none'))} -> {show(new[key])}" for key in differ)
