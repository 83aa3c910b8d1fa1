"""Your own features: the heading of a UAV, and how far the fleet is from being together.

    cd examples/extending
    damian train scenario=tracking \
        "observation.local_features=[spotted,features:heading]" \
        "observation.global_features=[source_distance,source_bearing,features:spread]"

A feature reads the fields of the messages that the server holds, [*, N], and returns values in
[0, 1], [*, N]; with ``@feature(scope, [2], low=-1.0)`` it returns [*, N, 2] in [-1, 1]
(``sensor.py``).
"""

import math

from torch import Tensor

from damian import feature
from damian.server.features import FeatureCache


@feature("local")
def heading(cache: FeatureCache) -> Tensor:
    """Heading of the UAV's latest flight, clockwise from north, over a full turn."""
    return cache.messages.track / (2 * math.pi)


@feature("global")
def spread(cache: FeatureCache) -> Tensor:
    """Standard deviation of the UAVs' positions, over the region's largest vertex distance."""
    place = cache.messages.position
    deviation = (
        (place - place.mean(-2, keepdim=True)).square().sum(-1).mean(-1, keepdim=True).sqrt()
    )
    return (deviation / cache.scale).clamp(max=1).expand(place.shape[:-1])
