"""The physical world: UAV motion, batteries, the signal source and messages, in metres, seconds and
radians.

Bearings and tracks are measured clockwise from north (the y axis). Modules here do not depend on
TorchRL.
"""
