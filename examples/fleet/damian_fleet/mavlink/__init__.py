"""A bridge between the service and vehicles that speak MAVLink, and simulated copters to try it."""
