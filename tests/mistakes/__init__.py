"""Mistakes of a new user, made with real daemons: what `check`, the logs and `status` say about each."""
