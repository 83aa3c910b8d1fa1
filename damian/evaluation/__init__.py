"""What runs come to: metrics, statistics, comparisons, and the files and figures of a run folder."""
