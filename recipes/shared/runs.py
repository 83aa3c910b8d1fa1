"""Runs in their folders, each alone or one of many: how they begin, go on and are refused.

A run may also take settings and policy of a stored one.
"""

import json
import random
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from damian.common.atomic_files import not_linked, remove_unfinished, write_atomically
from damian.common.devices import keep_freed_memory
from damian.common.errors import InputError
from damian.common.fields import filled, leaves, nested, set_at, value_at
from damian.common.registry import stored_settings
from damian.common.text_files import read_text, show
from damian.learners.config import LearnerConfig
from damian.runs.checkpoint import digest
from damian.runs.run_folder import CHECKPOINT, CONFIG, FAILED, RESULTS, check_no_links, locked
from damian.runs.run_record import check_version, read_record, timed, write_record
from damian.runs.training_state import checkpoint_file

from ..cli import EXPECTED, Work, command, options_in, plain, reason, short
from ..config import TrainConfig
from ..known import SCHEMAS, key_of, known_settings
from .settings import check_components

OVERRIDES = "overrides"
"""Entry of a run's record: the words of its command line, as they were typed."""
JOB, SEED = "job", "seed"
"""Entries of a run's record: its number in the sweep that it is of, and its seed."""
POLICY = "policy_sha256"
"""Entry of a run that begins with a stored policy: the SHA-256 of its checkpoint."""


@dataclass(frozen=True)
class Run:
    """A run in its folder: one that has begun goes on, and one that is finished is not repeated."""

    work: Work
    config: TrainConfig
    folder: Path
    needs: Path | None = None
    """Folder of the run whose policy this one flies, starts from, or imitates, if it does so."""
    stage: int = 0
    """Runs of a later stage need some of the earlier ones."""

    @property
    def name(self) -> str:
        return "/".join(self.folder.parts[-4:])

    @property
    def finished(self) -> bool:
        """Whether the folder holds results, and of the policy that the checkpoint holds now."""
        return (self.folder / RESULTS).exists() and self._same_policy

    @property
    def _same_policy(self) -> bool:
        policy = read_record(self.folder).get(POLICY)
        return policy is None or policy == digest(
            checkpoint_file(Path(str(self.config.checkpoint)))
        )

    def check(self) -> None:
        """Check that the folder has no links, and is empty or holds a run with the same
        settings."""
        check_no_links(self.folder)
        if not (self.folder / CONFIG).exists():
            return
        for key, old, new in changed_settings(self.config, self.folder, "hydra.run.dir"):
            if key not in ("resume", "checkpoint", "learner.teacher", "trust"):
                raise InputError(
                    f"{self.folder}: {key} is {old} in this stored run, and {new} is asked "
                    "for: delete the folder, or choose another one with hydra.run.dir"
                )

    def carry_out(self) -> None:
        """Do the work, or what is missing of it, after a check of what is there."""
        if self.needs is not None and not (self.needs / RESULTS).exists():
            raise InputError(f"checkpoint: {self.needs} has no finished policy")
        self.check()
        if not self.finished:
            self.perform()

    def perform(self, key: str = "hydra.run.dir") -> None:
        """Do the work in one thread with the run's seed; the setting ``key`` names the folder."""
        torch.set_num_threads(1)
        keep_freed_memory()
        seed_generators(self.config.seed)
        config = self.config
        folder = self.folder
        if config.region.zones and config.motion.kind == "instant":
            print(f"note: {CROSSES_ZONES}")
        with locked(folder, key):
            if (folder / CONFIG).exists() and (folder / CHECKPOINT).exists() and self._same_policy:
                config = replace(config, resume=str(folder))
            if not config.resume:
                (folder / RESULTS).unlink(
                    missing_ok=True
                )  # those of a policy that is not there any more
            remove_unfinished(folder)
            with timed(folder):
                self.work(config, folder)
        print(f"results: {folder}")


def start(work: Work, given: DictConfig, program: str = "train") -> None:
    """Do the work of a program with what Hydra has composed, in the folder that Hydra has made."""
    running = HydraConfig.get()
    folder = short(Path(running.runtime.output_dir))
    words = [*running.overrides.task]
    of_sweep = running.mode is RunMode.MULTIRUN
    if of_sweep:
        not_linked(folder, below=short(Path(running.sweep.dir).absolute()))
    errors = errors_kept_in(folder, words, program) if of_sweep else nullcontext()
    with errors, run_settings(given, words, program) as config:
        if program == "train" and config.resume:
            Run(work, config, Path(config.resume)).perform("resume")
        elif of_sweep:
            Run(work, config, folder).carry_out()
        else:
            if (folder / CONFIG).exists():
                remedy = f"choose another folder, or continue the run with resume={folder}"
                raise InputError(f"hydra.run.dir: {folder} holds a run already; {remedy}")
            Run(work, config, folder).perform()


@contextmanager
def errors_kept_in(folder: Path, words: Sequence[str], program: str = "train") -> Iterator[None]:
    """Keep what goes wrong with one of many runs in its folder, so that the others go on."""
    try:
        (folder / FAILED).unlink(missing_ok=True)
        yield
    except Exception as error:  # a run stands alone, whatever its settings and the user's code do
        if not isinstance(error, EXPECTED):
            traceback.print_exc()
        line = reason(error, program) or type(error).__name__
        print(f"failed: {folder}: {line}", file=sys.stderr)
        write_atomically(folder / FAILED, json.dumps({OVERRIDES: [*words], "error": line}) + "\n")


@contextmanager
def run_settings(given: DictConfig, words: Sequence[str], program: str = "train") -> Iterator[Any]:
    """The settings of a run, from what Hydra has composed and, if the words name one, from a stored
    run.

    If they name a file of settings, only code that the words name too is imported while those are
    in use.
    """
    values = plain(given, words, program)
    from_file = any(values.get(key) for key in ("checkpoint", "resume", "journal"))
    with stored_settings([*texts(values)], bool(values["trust"])) if from_file else nullcontext():
        if program == "train" and values["resume"] is not None:
            config = resumed(short(Path(values["resume"])), values, words)
        elif values.get("checkpoint") is not None:
            config = with_policy_of(values, words, program)
        else:
            config = filled(SCHEMAS[program], values)
        config.overrides = [*words]
        check_components(config)
        yield config


def texts(values: Any) -> Iterator[str]:
    """Every text in nested mappings and lists."""
    if isinstance(values, str):
        yield values
    elif isinstance(values, Mapping | Sequence):
        for each in values.values() if isinstance(values, Mapping) else values:
            yield from texts(each)


def changed_settings(config: TrainConfig, folder: Path, key: str) -> Iterator[tuple[str, Any, Any]]:
    """Settings that differ from those in a run folder: their keys, the stored values, and these.

    ``key`` is the setting that names the folder.
    """
    stored = stored_values(folder, key)
    for name, new in leaves(config):
        if (old := value_at(stored, name)) != new:
            yield name, old, new


CROSSES_ZONES = (
    "with motion=instant nobody lands in a no-fly zone, but ways cross it (motion=polynomial: "
    "around it)"
)
"""What is said of jumps, which take no way at all."""


def seed_generators(seed: int) -> None:
    """Seed the global random generators of torch, NumPy and Python; your own components may use
    each."""
    for set_seed in (torch.manual_seed, np.random.seed, random.seed):
        set_seed(seed)


def save_config(config: TrainConfig, folder: Path) -> None:
    """Write the record of words, versions and machine into the run folder, then the settings."""
    is_gpu = config.device.startswith("cuda")
    device = torch.cuda.get_device_name(config.device) if is_gpu else config.device
    entries = {OVERRIDES: [*config.overrides], SEED: config.seed}
    entries |= {"device": device, "threads": config.threads}
    if HydraConfig.initialized() and HydraConfig.get().mode is RunMode.MULTIRUN:
        entries[JOB] = HydraConfig.get().job.num
    if config.checkpoint and not config.resume:  # a resumed run no longer needs that policy
        entries[POLICY] = digest(checkpoint_file(Path(config.checkpoint)))
    write_record(folder, command(), config.resume is not None, **entries)
    write_atomically(
        folder / CONFIG, yaml.safe_dump(nested(config), sort_keys=False, allow_unicode=True)
    )


def run_folder(written: Path) -> Path:
    """The run folder that is written as ``checkpoint_file`` reads it."""
    return checkpoint_file(written).parent


def stored_values(folder: Path, key: str) -> dict[str, Any]:
    """The settings in a run folder as plain data: no text in them is resolved, and no code is
    imported.

    ``key`` is the setting that names the folder. Links in the folder are refused: the folder may
    come from anybody, and nothing outside of it is read, written or deleted for what it says.
    """
    file = folder / CONFIG
    if not file.is_file():
        raise InputError(f"{key}: {folder} holds no {CONFIG}, so there is no run")
    check_no_links(folder)
    check_version(folder, key)
    try:
        values = yaml.safe_load(read_text(file))
    except (InputError, yaml.YAMLError) as error:
        raise InputError(f"{key}: {file}: {reason(error)}") from None
    if not isinstance(values, dict) or not isinstance(values.get("learner"), dict):
        raise InputError(f"{key}: {file}: it does not hold the settings of a training")
    return values


def stored_config(folder: Path, key: str) -> TrainConfig:
    """The settings of the run in a folder; ``key`` is the setting that names it."""
    values = stored_values(folder, key)
    try:
        with stored_settings():
            return filled(TrainConfig, {name: values[name] for name in values if name in COMMON})
    except Exception as error:  # a damaged file can raise anything
        raise InputError(f"{key}: {folder / CONFIG}: {reason(error)}") from None


COMMON = {each.name for each in fields(TrainConfig)}
"""Settings that the runs of all programs have."""


def resumed(folder: Path, values: Mapping[str, Any], words: Sequence[str]) -> TrainConfig:
    """The settings of a run to resume; only ``frames`` and ``episodes`` may change."""
    allowed = ("resume", "frames", "episodes", "trust")
    stored = read_record(folder).get(OVERRIDES) or ()
    if refused := [word for word in words if key_of(word) not in allowed and word not in stored]:
        problem = (
            "a resumed run keeps its configuration; only frames= and episodes= may change; "
            "checkpoint="
        )
        problem += f"{folder} {refused[0]} begins a new run with its policy"
        raise InputError(f"{refused[0]}: {problem}")
    config = stored_config(folder, "resume")
    changed = {key: values[key] for key in ("frames", "episodes") if key in map(key_of, words)}
    return replace(config, resume=str(folder), **changed)


def with_policy_of(values: dict[str, Any], words: Sequence[str], program: str) -> Any:
    """The settings of a run that flies, or begins with, the policy of a stored run.

    Words lie over what is stored: a group's option replaces the settings that its options set, a
    key its value. What is not mentioned stays, and so do the histories that the policy observes.
    """
    stored = stored_config(run_folder(Path(values["checkpoint"])), "checkpoint")
    merged = nested(stored)
    kept = {key: value_at(merged, key) for key in ("delay.history", "delay.messages")}
    kinds = [kind for kind in SCHEMAS[program].__mro__ if kind not in TrainConfig.__mro__]
    own = {name for kind in kinds for name in kind.__annotations__}  # what only this program has
    given = {key_of(word).partition("@")[0] for word in words} | own
    mentioned = {"checkpoint", "resume", "trust"}.union(*(reach(key, program) for key in given))
    for key in sorted(mentioned):  # a section before its keys
        set_at(merged, key, value_at(values, key))
    for key, value in kept.items():
        if not given & {key, "aware"}:  # another option of delay leaves what the policy observes
            set_at(merged, key, value)
    config = filled(SCHEMAS[program], merged)
    check_policy_fits(config, stored)
    return config


def reach(key: str, program: str) -> set[str]:
    """The settings, and whole sections, that a word sets: of a group, those that any of its options
    sets.

    A scenario says nothing of the networks: they are those of the policy.
    """
    known = known_settings(program)
    found = {key} & known.keys()
    for written, chosen in options_in(key):
        settings = (each for each, setting in known.items() if not setting.is_section)
        found |= {each for each in settings if value_at(written, each, MISSING) is not MISSING}
        found |= {
            name.removeprefix("override /") for name in chosen if name.startswith("override /")
        }
    return found - {"model"} if key == "scenario" else found or {key}


def check_policy_fits(config: TrainConfig, stored: TrainConfig) -> None:
    """Check that a policy has the same observations, actions and layers in another scenario."""
    new = _shape(config)
    old = _shape(stored)
    for key, value in new.items():
        if value != old[key]:
            trained = show(old[key])
            asked = show(value)
            raise InputError(
                f"{key}: the policy was trained with {trained}, so it cannot fly with {asked}"
            )


def any_number_of_uavs(config: TrainConfig) -> bool:
    """Do the layers of a policy's networks have the same sizes for any number of UAVs?"""
    observation = config.observation
    both = config.learner.actor_follows_critic
    same = "agent_distances" not in (observation.critic if both else observation.actor)
    return same and config.model.shared


def _shape(config: TrainConfig) -> dict[str, Any]:
    """What the sizes of a policy's networks follow from, by setting."""
    observation = config.observation
    learner = config.learner
    settings = dict(leaves(config))
    own_actor = type(learner).make_actor is not LearnerConfig.make_actor
    sees_all = learner.actor_follows_critic or not observation.ctde
    discrete = config.actions.kind == "discrete"
    keys = [
        "observation.ctde",
        "observation.local_features",
        "observation.belief",
        "observation.age",
    ]
    keys += ["observation.timeline", "delay.history", "delay.messages", "actions.kind"]
    return {
        "learner": learner.name if own_actor else "an actor as mappo and sac have",
        **{
            key: settings[key]
            for key in (*keys, *(key for key in settings if key.startswith("model.")))
        },
        "observation.global_features": [*observation.global_features] * sees_all,
        "source.count, of a belief": bool(observation.belief) and config.source.count,
        "agents": "any number of UAVs" if any_number_of_uavs(config) else config.agents,
        "number of actions.distances": discrete and len(config.actions.distances),
        "number of actions.headings": discrete and len(config.actions.headings),
    }
