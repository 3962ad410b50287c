"""The command ``uavlink-mitm``: a man in the middle, an emulated radio, or a hostile relay.

Exit status 0: success. 1: failure, and standard error has the reason. 2: wrong command line or configuration.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from uavlinkd.lab.mitm.cli import main as mitm_main


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    if words[:1] != ["relay"]:
        return mitm_main(words)
    from uavlinkd.lab.hostile.relay_cli import relay_main  # noqa: PLC0415  no other command holds a key

    return relay_main(words[1:])


if __name__ == "__main__":
    sys.exit(main())
