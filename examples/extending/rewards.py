"""Your own reward terms: a price for a low battery, and a reward for staying together.

    cd examples/extending
    damian train scenario=energy \
        "reward.custom=[{term: rewards:low_battery, weight: -0.2, below: 0.5}]"
    damian train "reward.custom=[{term: rewards:together, weight: 0.1}]"

A term reads features by name and returns a value for each UAV, [*, N]; its keyword-only arguments
are parameters. Its name is its column in metrics.csv: ``reward/low_battery``.
"""

from torch import Tensor

from damian import reward_term
from damian.server.rewards import Counters

Features = dict[str, Tensor]


@reward_term(reads=["battery"])
def low_battery(features: Features, counters: Counters, *, below: float = 0.3) -> Tensor:
    """1 while the observed battery level is below a share of a full one."""
    return (features["battery"] < below).float()


@reward_term(reads=["features:spread"], scope="system")
def together(features: Features, counters: Counters) -> Tensor:
    """1 minus the spread of the fleet, your own feature (``features.py``)."""
    return 1 - features["features:spread"]
