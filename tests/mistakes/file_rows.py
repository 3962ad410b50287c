"""Mistakes in a file or a command line: `check`, or the command itself, answers.

Others are in `tests/config` and `tests/fleet`: what these commands print is the text of the error.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from tests.mistakes.row import Mistake
from tests.mistakes.scene import Scene, checked, checked_file, said


async def _own_key(scene: Scene) -> None:
    scene.introduce()
    scene.here.config["peer"][0]["public_key"] = scene.here.public_key
    scene.check = checked(scene.here)


async def _without_quotation_mark(scene: Scene) -> None:
    path = scene.here.write_config()
    path.write_text(path.read_text().replace(f'"{scene.here.name}"', f'"{scene.here.name}', 1))
    scene.check = checked_file(path)


def _fleet(*arguments: str) -> Callable[[Scene], Awaitable[None]]:
    """A fleet command in the folder of a fleet."""

    async def make(scene: Scene) -> None:
        folder = str(scene.stage.folder / f"fleet{scene.row}")
        said("fleet", "init", "--no-passphrase", "--out", folder)
        scene.command = said("fleet", *arguments, "--out", folder)

    return make


async def _no_control_socket(scene: Scene) -> None:
    del scene.here.config["control_socket"]
    scene.command = said("status", "--config", str(scene.here.write_config()))


async def _windows(scene: Scene) -> None:
    """An editor of Windows wrote a byte order mark and its line ends."""
    path = scene.here.write_config()
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    scene.check = checked_file(path)


FILE_ROWS = (
    Mistake("2", _own_key, check=r"own key: .*`uavlinkd pubkey`.* or private_key_file is that of"),
    Mistake("15", _without_quotation_mark, check=r":\d+:.*write name = "),
    Mistake("40", _no_control_socket, command=r'add control_socket = "NAME\.sock"'),
    Mistake("43", _windows, check=r"public key"),
    Mistake("56a", _fleet("init", "--no-passphrase"), command=r"exists already: choose the name"),
    Mistake("56e", _fleet("sign", "v7", "--address", "vps"), command=r"--address: has no port"),
    Mistake("56k", _fleet("revoke", "drone9"), command=r'has no "drone9": its members are none'),
)
