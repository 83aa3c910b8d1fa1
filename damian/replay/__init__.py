"""Stored steps: back-updating with late messages, and decisions as semi-Markov transitions."""
