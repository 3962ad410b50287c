"""A relay that attacks the members whose datagrams it forwards. It holds a relay's key, and no key of a member."""
