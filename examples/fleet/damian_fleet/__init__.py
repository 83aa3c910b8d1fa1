"""A service for fleets of real UAVs: their reports come in, and where each should land goes out."""
