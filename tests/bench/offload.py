"""Makes a veth behave like the drivers of network cards: merge datagrams on receipt, on request (UDP_GRO).

``offload DEVICE``, run in the device's namespace. veth hands packets to its receive queue, where they are merged,
only if the sending end claims no segmentation offload for TCP, so that is switched off. See ethtool(8): it is done by
its ioctl, as the command is not installed everywhere.
"""

from __future__ import annotations

import ctypes
import fcntl
import socket
import struct
import sys
from typing import Final

SIOCETHTOOL: Final = 0x8946  # linux/sockios.h
ETHTOOL_STSO: Final = 0x1F  # linux/ethtool.h
ETHTOOL_SGRO: Final = 0x2C
_VALUE: Final = struct.Struct("II")  # struct ethtool_value: command, data
_REQUEST: Final = struct.Struct("16sP16x")  # struct ifreq: the device's name, and where the value is


def main() -> None:
    """Switch them.

    Raises:
        OSError: the device is not there, or cannot do it.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for command, value in ((ETHTOOL_STSO, 0), (ETHTOOL_SGRO, 1)):
            data = ctypes.create_string_buffer(_VALUE.pack(command, value))
            fcntl.ioctl(sock, SIOCETHTOOL, _REQUEST.pack(sys.argv[1].encode(), ctypes.addressof(data)))


if __name__ == "__main__":
    main()
