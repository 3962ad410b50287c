"""Limits and times of a fleet with an authority. README.md has them in its table."""

from __future__ import annotations

from uavlinkd.protocol.constants import Rate

CERTIFIED_PEERS = 256  # peers by certificate, provisional ones included: one for each system id
CONTACTS_FIRST_S = 1.0
HAVE_INTERVAL_S = 10.0
HAVE_LEAST_S = 0.1
PUSH_JITTER_S = 0.1
"""Otherwise all members that got a bulletin together send it to each other at the same moment."""
PUSH_AGAIN_S = 0.2
PUSH_TRIES = 10
BULLETIN_LEAST_S = 1.0
"""A captured member causes one signature check a second, 60 µs."""
WHO_INTERVAL_S = 600.0
"""Members that come later ask too, and are introduced by their binds: this is for losses."""
WHO = Rate(4.0, 40)
CERTIFICATES_PER_ANSWER = 8
CERTIFICATES = Rate(32.0, 256)
INTRODUCTIONS = Rate(8.0, 200)
"""A ground station that starts behind a relay learns of its whole fleet at once."""
INTRODUCED_AFTER_S = 0.5
"""After a session a member binds those that it knows. Until then no other is introduced to it."""
INTRODUCED_AGAIN_S = 0.5
INTRODUCED_TRIES = 3
"""In a session. A lost one would else follow with the next bind, after 5 s."""
