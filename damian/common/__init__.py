"""Checks, errors, random numbers and other helpers that know nothing of UAVs or of learning."""
