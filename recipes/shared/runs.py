"""Runs in their folders: starting and resuming them, and taking settings and policy of a stored one."""

import random
from collections.abc import Collection, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from damian.common.atomic_files import remove_unfinished, write_atomically
from damian.common.errors import InputError
from damian.common.fields import filled, leaves
from damian.common.registry import IMPORTED, stored_settings
from damian.common.text_files import show
from damian.envs.config import ScenarioConfig
from damian.learners.config import LEARNERS, LearnerConfig
from damian.runs.checkpoint import digest
from damian.runs.run_folder import CONFIG
from damian.runs.run_record import check_version, read_record, timed, write_record
from damian.runs.training_state import checkpoint_file

from ..cli import Work, checked, command, composed, reason, shown, stored_words, texts
from ..config import TrainConfig
from ..known import SCHEMAS, check_words, key_of
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
    folder = run_folder(Path(given.checkpoint))
    stored = stored_config(folder, "checkpoint")
    before = stored_words(read_record(folder).get(OVERRIDES), "train", "checkpoint", own_folder)
    defaults = {each.name: each.default for each in fields(TrainConfig)}
    others = [f.name for f in fields(SCHEMAS[program]) if f.default != defaults.get(f.name, f.default)]
    overrides = inherited(stored, before, words, others)
    check_words(program, overrides, own_folder)
    config = checked(composed(program, overrides, own_folder), program)
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


def stored_values(folder: Path, key: str) -> dict[str, Any]:
    """The settings in a run folder as plain data: no text in them is resolved, and no code is imported."""
    file = folder / CONFIG
    if not file.is_file():
        raise InputError(f"{key}: {folder} holds no {CONFIG}, so there is no run")
    check_version(folder, key)
    try:
        return cast(dict[str, Any], OmegaConf.to_container(OmegaConf.load(file)))
    except Exception as error:  # a damaged file can raise anything
        raise InputError(f"{key}: {file}: {reason(error)}") from None


def stored_config(folder: Path, key: str) -> TrainConfig:
    """The settings of the run in a folder; ``key`` is the setting that names it."""
    values = stored_values(folder, key)
    try:
        with stored_settings():
            name = values["learner"]["name"]
            learner = LEARNERS.get(name, "learner")(name=name)
            return filled(TrainConfig(learner=learner), values)
    except Exception as error:  # a damaged file can raise anything
        raise InputError(f"{key}: {folder / CONFIG}: {reason(error)}") from None


def names_own_code(config: TrainConfig) -> bool:
    """Do the settings name components of your own, which a program imports only with ``trust=true``?"""
    return not IMPORTED.isdisjoint(texts(asdict(config)))


def resumed(folder: Path, given: DictConfig, words: Sequence[str]) -> TrainConfig:
    """The settings of a run to resume; only ``frames`` and ``episodes`` may change."""
    allowed, stored = ("resume", "frames", "episodes", "trust"), read_record(folder).get(OVERRIDES) or ()
    if refused := [word for word in words if key_of(word) not in allowed and word not in stored]:
        problem = "a resumed run keeps its configuration; only frames= and episodes= may change; checkpoint="
        problem += f"{folder} {refused[0]} begins a new run with its policy"
        raise InputError(f"{refused[0]}: {problem}")
    config = stored_config(folder, "resume")
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
    observation, both = config.observation, config.learner.actor_follows_critic
    return "agent_distances" not in (observation.critic if both else observation.actor)


def _shape(config: TrainConfig) -> dict[str, Any]:
    """What the sizes of a policy's networks follow from, by setting."""
    observation, actions, model = config.observation, config.actions, config.model
    discrete, learner = actions.kind == "discrete", config.learner
    own_actor = type(learner).make_actor is not LearnerConfig.make_actor
    return {
        "learner": learner.name if own_actor else "an actor as mappo and sac have",
        "observation.ctde": observation.ctde,
        "observation.local_features": [*observation.local_features],
        "observation.global_features": [*observation.global_features]
        * (learner.actor_follows_critic or not observation.ctde),
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
