"""Files of a run folder: checkpoints, metrics, loggers, the lock and the record."""
