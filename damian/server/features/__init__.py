"""Features: what observations and rewards are computed from, one file for each family."""

from damian.server.features import belief, coverage, others, place, requests, source, timeline  # noqa: F401
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
