"""Everything with a side effect: the loop, run folders, checkpoints, logs, progress."""
