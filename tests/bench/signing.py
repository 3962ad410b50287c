"""A relay as pymavlink's users write it: ``signing sign|verify INTO OUT KEYFILE``, MAVLink 2's own signatures.

``sign`` packs each message again with a signature; ``verify`` passes on, byte for byte, what is signed with the key.
"""

from __future__ import annotations

import sys
from pathlib import Path


def main() -> None:
    what, into_url, out_url, key_file = sys.argv[1:]
    from pymavlink import mavutil

    into, out = mavutil.mavlink_connection(into_url), mavutil.mavlink_connection(out_url)
    (out if what == "sign" else into).setup_signing(Path(key_file).read_bytes())
    while True:
        message = into.recv_match(blocking=True)
        if message is None or message.get_type() == "BAD_DATA":
            continue
        if what == "sign":
            out.mav.srcSystem, out.mav.srcComponent = message.get_srcSystem(), message.get_srcComponent()
            out.mav.send(message)
        else:
            out.write(message.get_msgbuf())


if __name__ == "__main__":
    main()
