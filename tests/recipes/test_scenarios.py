"""The scenarios of the configuration, as the command line composes them."""

from functools import cache
from pathlib import Path

import pytest

from damian.recipes.cli import settings as composed_config
from damian.settings import TrainConfig

FOLDER = Path(__file__).parents[2] / "conf" / "scenario"
SCENARIOS = sorted(
    str(file.relative_to(FOLDER).with_suffix("")) for file in FOLDER.rglob("*.yaml") if file.name[0] != "_"
)
OPTIONS = "reward=coverage", "model=gru", "delay=burst", "links=updown"


@cache
def composed(*overrides: str) -> TrainConfig:
    """The settings of a training."""
    return composed_config(*overrides)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_options_of_the_command_line_replace_those_of_the_scenario(scenario):
    found, expected = composed(f"scenario={scenario}", *OPTIONS), composed(*OPTIONS)
    for group in ("reward", "model", "delay", "links"):
        assert getattr(found, group) == getattr(expected, group), group
