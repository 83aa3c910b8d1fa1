"""Components with one mistake each, which ``test_mistakes.py`` uses as ``wrong:name``."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from torch import Tensor

from damian import ContextSampler, Law, MessageContext, feature, reward_term, sensor
from damian.server.features import FeatureCache
from damian.server.rewards import Counters
from damian.world.airspace import Airspace
from damian.world.config import WorldConfig
from damian.world.regions.config import RegionConfig
from damian.world.regions.region import Region
from damian.world.simulation import Simulation
from damian.world.state import State
from damian.world.vehicles import PolynomialFlight


@dataclass(frozen=True)
class Rush(Law):
    """A law that makes the mistake of this name."""

    mistake: str
    start: Any = 3.0

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Any:
        if self.mistake == "raise":
            raise RuntimeError("no\n  signal")
        if self.mistake == "none":
            return None
        return ContextSampler(getattr(self, self.mistake), 5, loss)

    def typo(self, context: MessageContext) -> Tensor:
        return context.tme  # type: ignore[attr-defined]

    def branch(self, context: MessageContext) -> Tensor:
        return context.time if context.time > self.start else context.time + 1

    def compares(self, context: MessageContext) -> Tensor:
        return (context.time > self.start).long()

    def undeclared(self, context: MessageContext) -> Tensor:
        return context.entries["position"][:, 0]


@sensor()
def unmarked(state: State, world: Simulation, half: float = 3.0) -> Tensor:
    """Its parameter stands before a ``*``."""
    return state.battery / half


@feature("local")
def absent(cache: FeatureCache) -> Tensor:
    return cache.message.track  # type: ignore[attr-defined]


@feature("local", high=1e9)
def divided(cache: FeatureCache) -> Tensor:
    return 0 / cache.messages.track


@feature("local")
def flag(cache: FeatureCache) -> Tensor:
    """No mistake: a flag is a number too."""
    return cache.messages.spotted


@feature("local")
def precise(cache: FeatureCache) -> Tensor:
    """No mistake: any type of number will do."""
    return cache.messages.battery.double() / 100


@feature("local", low=-1e3, high=1e3)
def mean_place(cache: FeatureCache) -> Tensor:
    east = cache.messages.position[..., 0]
    return east.mean(-1, keepdim=True).expand_as(east)


@feature("local", width=2)
def single(cache: FeatureCache) -> Tensor:
    """It declares two values for each UAV."""
    return cache.messages.track


@reward_term(reads=["spotted"])
def undeclared(features: dict[str, Tensor], counters: Counters) -> Tensor:
    return features["battery"] + features["spotted"]


@reward_term(reads=["spotted"])
def exact(features: dict[str, Tensor], counters: Counters) -> Tensor:
    """No mistake: any type of number will do."""
    return features["spotted"].double()


@reward_term(reads=["spotted"])
def scalar(features: dict[str, Tensor], counters: Counters) -> Any:
    return 1.0


@reward_term(reads=["spotted"])
def hopeless(features: dict[str, Tensor], counters: Counters) -> Tensor:
    return (features["spotted"] - 2).log()


@reward_term(reads=["spotted", "batery"])
def misspelt(features: dict[str, Tensor], counters: Counters) -> Tensor:
    return features["batery"]


def park(config: RegionConfig, rng: np.random.Generator) -> Any:
    """A region source that makes the mistake that its options name."""
    corners = {"crossing": [(0, 0), (200, 200), (200, 0), (0, 200)]}
    area = shapely.Polygon(corners.get(config.options, [(0, 0), (200, 0), (200, 200), (0, 200)]))
    returned = {
        "region": Region(area, "park"),
        "polygon": area,
        "none": None,
        "nothing": [],
        "polygons": [area],
        "points": [Region(area.centroid, "park")],  # type: ignore[arg-type]
        "crossing": [Region(area, "park")],
        "many": [Region(area, "park")] * 9,
    }
    return returned[config.options]


def no_arguments() -> list[Region]:
    return []


class Flight(PolynomialFlight):
    """A motion model that makes the mistake that its options name."""

    def __init__(self, config: WorldConfig, airspace: Airspace, dt: float) -> None:
        super().__init__(config, airspace, dt)
        self.mistake = config.motion.options["mistake"]
