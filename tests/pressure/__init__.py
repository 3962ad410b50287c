"""A daemon under attack by senders that know its public key or hold a peer's keys: what its other peers notice."""
