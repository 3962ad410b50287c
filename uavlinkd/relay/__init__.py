"""The relay: it passes datagrams between its members, and has no key of a session between two of them."""
