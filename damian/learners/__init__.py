"""Learners of a policy: MAPPO and SAC, their networks, and the system clock that times their updates."""
