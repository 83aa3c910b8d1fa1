"""Reinforcement learning: networks, losses, and learners that turn collected steps into better
policies."""
