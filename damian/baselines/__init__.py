"""Policies that learn nothing, to compare learners with: a random one and a scripted one."""
