"""What an operator sees: control socket, status, metrics, logs and recordings."""
