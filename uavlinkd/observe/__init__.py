"""What watches a daemon: findings as one table, the log with its limits, the status. No frame's path calls it."""
