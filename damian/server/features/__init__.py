"""Features: what observations and rewards are computed from, one file for each family."""

from damian.server.features import (  # noqa: F401
    actions,
    belief,
    coverage,
    others,
    place,
    requests,
    source,
    timeline,
)
from damian.server.features.base import (
    FEATURES,
    FeatureCache,
    ServerContext,
    feature,
    feature_of,
    layout_of,
    observe,
    observe_own,
    stack,
)

__all__ = [
    "FEATURES",
    "FeatureCache",
    "ServerContext",
    "feature",
    "feature_of",
    "layout_of",
    "observe",
    "observe_own",
    "stack",
]
