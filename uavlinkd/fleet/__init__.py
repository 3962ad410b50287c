"""The keys and configurations of a whole fleet, made and maintained by one command."""
