"""Checks, errors, random numbers and other helpers that depend on neither the UAV world nor
learning."""
