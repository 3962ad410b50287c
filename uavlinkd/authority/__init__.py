"""The rules of a fleet with an authority: who is a member, and how bulletins travel. README.md specifies them."""
