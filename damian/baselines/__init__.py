"""Policies that do not learn, as baselines for learners: a random one and a scripted one."""
