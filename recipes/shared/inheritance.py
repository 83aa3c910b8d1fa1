"""A run that takes the policy of another one: the settings that it keeps, and those that must not change."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from damian.common.errors import InputError
from damian.common.text_files import show
from damian.envs.pipeline import history_since_message
from damian.envs.scenario import ScenarioConfig
from damian.learners.predictive_mappo import PredictiveMappoConfig

from .settings import TrainConfig


def inherited(stored: TrainConfig, overrides: Sequence[str], own: Collection[str] = ()) -> list[str]:
    """The given overrides, preceded by those of a stored run that they do not replace.

    The policy keeps its histories of actions and messages, because it observes them, even if a file of the
    stored run's scenario or an option of ``delay`` says otherwise.

    Args:
        stored: settings of the stored run.
        overrides: those of the new program.
        own: keys that have another default in this program, which those of the stored run do not replace.
    """
    given = [*map(key_of, overrides), *own]
    history = [] if {"delay.history", "aware"} & {*given} else [f"delay.history={stored.delay.history}"]
    messages = stored.delay.messages
    history += [f"delay.messages={messages}"] if messages and "delay.messages" not in given else []
    replaced = [*given, *map(key_of, history)]
    return [*without(stored.overrides, replaced), *history, *overrides]


def without(overrides: Sequence[str], replaced: Collection[str]) -> list[str]:
    """The overrides but those that set one of these keys and groups."""
    return [old for old in overrides if not any(_replaces(key, key_of(old)) for key in replaced)]


def own_defaults(kind: type) -> set[str]:
    """Keys of the training to which the settings of another program give another default."""
    defaults = {field.name: field.default for field in fields(TrainConfig)}
    return {field.name for field in fields(kind) if field.default != defaults.get(field.name, field.default)}


def key_of(override: str) -> str:
    """The key or group that an override sets."""
    return override.lstrip("+~").partition("=")[0]


def _replaces(given: str, key: str) -> bool:
    """Does an override of ``given``, a key or a group, replace an earlier override of ``key``?"""
    return key == given or key.startswith(f"{given}.")


def check_policy_fits(config: TrainConfig, stored: TrainConfig) -> None:
    """Check that a policy can fly in another scenario than the one that it was trained in.

    Raises:
        InputError: its observations, actions or layers would differ; the message names the setting.
    """
    new, old = _shape(config), _shape(stored)
    for key, value in new.items():
        if value != old[key]:
            trained, asked = show(old[key]), show(value)
            raise InputError(f"{key}: the policy was trained with {trained}, so it cannot fly with {asked}")


def _shape(config: TrainConfig) -> dict[str, Any]:
    """What the sizes of a policy's networks follow from, by setting."""
    observation, actions, model = config.observation, config.actions, config.model
    discrete, predicts = actions.kind == "discrete", isinstance(config.learner, PredictiveMappoConfig)
    # An actor with a learnt belief predicts the critic's observation, so that its layers depend on it too.
    used = observation.critic if predicts else observation.actor
    return {
        "learner=predictive_mappo": predicts,
        "observation.ctde": observation.ctde,
        "observation.local_features": [*observation.local_features],
        "observation.global_features": [*observation.global_features] * (predicts or not observation.ctde),
        "observation.belief": [*observation.belief],
        # After the features, from which it follows: a policy with other features does not lack UAVs.
        "agents": config.agents if "agent_distances" in used else "any number of UAVs",
        "observation.age": observation.age,
        "delay.history": config.delay.history,
        "delay.messages": config.delay.messages,
        "actions.kind": actions.kind,
        "number of actions.distances": discrete and len(actions.distances),
        "number of actions.headings": discrete and len(actions.headings),
        **{f"model.{field.name}": getattr(model, field.name) for field in fields(model)},
    }


def note_what_a_history_holds(config: TrainConfig, stored: TrainConfig) -> None:
    """Say if a policy observes other actions in its history than in its training, which had other delays."""
    before, now = history_since_message(stored), history_since_message(config)
    if before == now or not (stored.delay.history and config.delay.history):
        return
    newer = "only actions newer than its message that the server holds"
    held, holds = (newer if since else "all of its latest actions" for since in (before, now))
    print(f"note: delay.history: in the training a UAV's history held {held}; now it holds {holds}")


def changes(config: TrainConfig, stored: TrainConfig) -> str:
    """The settings of the scenario that differ between a stored run and a new one, on one line."""
    names = {field.name for field in fields(ScenarioConfig)}
    old, new = (
        {k: v for k, v in settings_by_key(each) if k.split(".")[0] in names} for each in (stored, config)
    )
    differ = [key for key in new if old[key] != new[key]]
    return ", ".join(f"{key}: {show(old[key])} -> {show(new[key])}" for key in differ)


def settings_by_key(config: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every setting of nested dataclasses by its dotted key."""
    for field in fields(config):
        value = getattr(config, field.name)
        if is_dataclass(value):
            yield from settings_by_key(value, f"{path}{field.name}.")
        else:
            yield f"{path}{field.name}", value
