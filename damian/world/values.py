"""Settings as numbers: one for all UAVs, one for each, or one that is drawn for each world and
episode."""

from typing import NamedTuple

import torch
from torch import Tensor

from damian.common import counter_rng
from damian.common.fields import rules
from damian.world.config import WorldConfig

Value = float | Tensor
"""A number, one for each UAV [N], or one for each world [B, 1]."""


class Values(NamedTuple):
    """Where the values of settings are found by their keys."""

    settings: dict[str, Value]
    """All of them; a list of one for each UAV is a tensor [N] in double precision."""
    choices: dict[str, list[float]]
    """Settings that are drawn, and the range, or the values, from which."""
    streams: dict[str, int]
    """Numbers of the streams of what is drawn; computed within a step, they would not compile."""

    def draw(self, seed: Tensor, episode: Tensor) -> Tensor:
        """The drawn values of an episode, [B, D], by the seeds and numbers of episodes of the
        worlds [B]."""
        columns = []
        for key, values in self.choices.items():
            share = counter_rng.uniform(seed, self.streams[key], episode)
            if len(values) == 2:
                columns.append(values[0] + (values[1] - values[0]) * share)
            else:
                columns.append(
                    torch.tensor(values, device=share.device)[(share * len(values)).long()]
                )
        return (
            torch.stack(columns, -1) if columns else torch.zeros(len(seed), 0, device=seed.device)
        )

    def get(self, key: str, drawn: Tensor) -> Value:
        """The value of a setting in worlds whose drawn values are ``drawn`` [B, D]."""
        if key not in self.choices:
            return self.settings[key]
        return drawn.narrow(-1, [*self.choices].index(key), 1)


def times(values: Tensor, factor: Value) -> Tensor:
    """Values [*, N] times a factor, in the precision of the values."""
    return values * (factor.to(values.dtype) if isinstance(factor, Tensor) else factor)


def values_of(config: WorldConfig) -> Values:
    """The values of the settings of a world."""
    settings = {}
    for section in (config.motion, config.battery, config.wind, config.source):
        for name, rule in rules(type(section)).items():
            value = getattr(section, name)
            if isinstance(value, float):
                settings[section.key(name)] = value
            elif rule.each:
                settings[section.key(name)] = torch.tensor(value, dtype=torch.float64)
    choices = {key: [*map(float, values)] for key, values in config.randomise.items()}
    if config.is_windy and config.wind.direction is None:
        choices.setdefault("wind.direction", [0.0, 360.0])
    return Values(settings, choices, {key: counter_rng.number_of(key) for key in choices})
