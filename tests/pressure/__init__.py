"""A daemon under attack by senders that know its public key or hold a peer's keys: the effect on its other peers."""
