"""What stands between two daemons without any of their keys: an emulated radio, and the man in the middle."""
