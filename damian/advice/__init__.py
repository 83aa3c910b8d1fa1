"""Advice for real UAVs: the server node of a fleet outside the simulation, fed by reported observations."""
