"""Evaluation of runs: metrics, statistics, comparisons, and the files and figures of a run folder."""
