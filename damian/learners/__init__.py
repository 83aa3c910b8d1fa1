"""Algorithms that learn a policy: MAPPO and SAC, their networks, and when they learn."""
