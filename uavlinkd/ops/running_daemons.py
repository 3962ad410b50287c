"""Finds the daemons of this machine by their control sockets, where the systemd units put them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

RUNTIME_FOLDER: Final = Path("/run/uavlinkd")
SOCKET_NAME: Final = "control.sock"


class NoSocketError(Exception):
    """There is no control socket, or this user may not look for one. The message says what to do."""


def control_sockets(folder: Path = RUNTIME_FOLDER) -> list[Path]:
    """The control sockets in the folder of the service and in those of its instances, by name.

    Raises:
        NoSocketError: no daemon has one there, or this user may not look for it.
    """
    candidates = [folder / SOCKET_NAME, *sorted(folder.glob(f"*/{SOCKET_NAME}"))]
    if not (sockets := [path for path in candidates if os.path.lexists(path)]):
        raise NoSocketError(
            f"no control socket in {folder} that this user may see: use sudo, start the service (`systemctl start"
            f' uavlinkd`) with control_socket = "{folder / SOCKET_NAME}" in its file, or name the daemon:'
            " --config FILE or --socket PATH"
        )
    return sockets
