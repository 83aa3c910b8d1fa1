"""Comparison of methods over tasks, delays and seeds: statistics, tables and figures."""
