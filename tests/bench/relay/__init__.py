"""What a relay carries, beside coturn on the same work."""
