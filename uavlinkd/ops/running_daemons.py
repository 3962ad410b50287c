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
    try:
        names = sorted(os.listdir(folder))
    except PermissionError:
        raise NoSocketError(_not_permitted(folder)) from None
    except OSError:
        raise NoSocketError(_none(folder)) from None
    candidates = [folder / SOCKET_NAME, *(folder / name / SOCKET_NAME for name in names if name != SOCKET_NAME)]
    sockets: list[Path] = []
    is_hidden = False
    for path in candidates:
        try:
            path.lstat()
        except PermissionError:
            is_hidden = True
        except OSError:
            continue
        else:
            sockets.append(path)
    if not sockets:
        raise NoSocketError(_not_permitted(folder) if is_hidden else _none(folder))
    return sockets


def _none(folder: Path) -> str:
    return (
        f"no daemon has a control socket in {folder}: start the service (`systemctl start uavlinkd`) with"
        f' control_socket = "{folder / SOCKET_NAME}" in its file, or name the daemon: --config FILE or --socket PATH'
    )


def _not_permitted(folder: Path) -> str:
    return f"no permission to look into {folder}: only root and the daemon's user have it; use sudo"
