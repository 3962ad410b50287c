"""A whole fleet from one command: keys, pairwise secrets, and a complete configuration for each vehicle."""
