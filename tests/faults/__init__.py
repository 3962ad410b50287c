"""Faults of the machine and the network around a real daemon, and how soon it is back."""
