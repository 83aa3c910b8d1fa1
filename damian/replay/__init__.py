"""Replay storages: back-updating of stored steps with late messages, and semi-Markov
transitions."""
