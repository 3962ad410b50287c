"""The plans of attacks on members by certificate."""

from __future__ import annotations

from typing import Final

from uavlinkd.lab.evaluation.tampering_plan import FLEET, plan_rows

_UNANSWERED: Final = "drop-message,message=response"
"""A daemon that starts shows its certificate until it is answered."""

FLEET_PLANS: Final = plan_rows(
    FLEET,
    f"""
initiations with certificates replayed | replay-initiation,kinds=certificate,copies=20 {_UNANSWERED}
    | restarts needs=duplicate
initiations with certificates replayed later
    | replay-initiation,kinds=certificate,copies=20,when=later,delay_s=12 {_UNANSWERED}
    | restarts is_variant after_s=12.1 needs=duplicate
initiations with certificates truncated | truncate,kinds=certificate | restarts needs=malformed
initiations with certificates extended | extend,kinds=certificate | restarts needs=malformed
certificates cut off and added | certificate-length {_UNANSWERED} | restarts needs=bad_handshake
initiations with certificates dropped | drop,kinds=certificate | restarts needs=handshakes_unanswered
records replayed | replay-data,kinds=record,copies=20 | restarts needs=duplicate
records replayed later | replay-data,kinds=record,copies=20,when=later,delay_s=3
    | restarts is_variant after_s=3.1 needs=late_copy
flood of the length of certificates | flood-initiations,certificate=true,rate_per_s=1500 | needs=bad_handshake
flood of recorded certificates | flood-replays,kinds=certificate,rate_per_s=1500 {_UNANSWERED}
    | restarts needs=replayed_initiation
""",
    least_s=3.0,
    takes_away=True,
)
"""On two members by certificate. The second one has the first as its contact. The first one has forgotten it after a
restart of both."""

FLEET_RELAY_PLANS: Final = plan_rows(
    FLEET,
    """
relay hides members and bulletins | relay-withhold | restarts least_s=5 -targeted
relay sends recorded certificates | relay-introduce,lie=recorded | needs=member_conflict,certificate_revoked
relay sends certificates with other keys | relay-introduce,lie=key | needs=bad_certificate
relay sends altered certificates | relay-introduce | needs=bad_certificate
relay floods certificates | relay-introduce,rate_per_s=600 | needs=record_over_limit
""",
    least_s=3.0,
    takes_away=True,
)
"""On three members by certificate along a hostile relay of the same fleet."""
