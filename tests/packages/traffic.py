"""Inside the machine: send position reports ten times a second and write the time of each one that arrives.

Arguments: the port of the sending endpoint, the receiving port, and the file of the times.
"""

from __future__ import annotations

import socket
import sys
import time

PERIOD_S = 0.1


def main(sending: int, receiving: int, path: str) -> None:
    """Run until a signal; each line of standard input is a frame."""
    frames = [bytes.fromhex(line) for line in sys.stdin]
    number = 0
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        open(path, "w", buffering=1) as times,
    ):
        receiver.bind(("127.0.0.1", receiving))
        while True:
            sender.sendto(frames[number % len(frames)], ("127.0.0.1", sending))
            number += 1
            next_s = time.monotonic() + PERIOD_S
            while (left_s := next_s - time.monotonic()) > 0:
                receiver.settimeout(left_s)
                try:
                    receiver.recv(2048)
                except TimeoutError:
                    break
                times.write(f"{time.monotonic()}\n")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3])
