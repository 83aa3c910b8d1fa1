"""The physical world: pure functions and frozen data in metres, seconds and radians.

Bearings and tracks are clockwise from north (y). Nothing here knows reinforcement learning.
"""
