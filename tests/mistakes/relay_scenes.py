"""How the mistakes with a relay are made: with the relay and a member of it, or with two members and a relay."""

from __future__ import annotations

import os
import socket
from typing import Any

from tests.mistakes.scene import Scene, checked, said_by_process
from tests.needs import need
from tests.processes.fleet import make_relay, relay_for
from tests.processes.process import DaemonProcess
from uavlinkd.config import keys


def _key() -> str:
    return keys.public_key_text(keys.generate_private_key())


def _member(member: DaemonProcess, relay: DaemonProcess) -> None:
    """Make a daemon a member of a relay. Its peer, the other member, is off."""
    make_relay(relay, member)
    relay.config["member"].append({"name": "station", "public_key": _key()})
    member.config["link"]["confidential"] = True
    member.config["peer"].append(
        {"name": "station", "public_key": relay.config["member"][1]["public_key"], "role": "all", "system_ids": "all"}
    )


def _used(member: DaemonProcess) -> dict[str, Any]:
    section: dict[str, Any] = member.config["relay"][0]
    return section


async def _checked_start(scene: Scene) -> None:
    scene.check = checked(scene.here)
    await scene.start()


async def member_missing(scene: Scene) -> None:
    """The relay `here` has no [[member]] for `there`."""
    _member(scene.there, scene.here)
    scene.here.config["member"][0]["public_key"] = _key()
    await _checked_start(scene)


async def copied_card(scene: Scene) -> None:
    """A third daemon has the key of `there`, and both are at the relay `here`."""
    _member(scene.there, scene.here)
    await scene.start(scene.here, scene.there, scene.clone(scene.there))


async def relay_key(scene: Scene) -> None:
    """`here` has a random key for the relay."""
    _member(scene.here, scene.there)
    _used(scene.here)["public_key"] = _key()
    await _checked_start(scene)


async def exchanged_keys(scene: Scene) -> None:
    """`here` has the key of the relay for its peer, and that of its peer for the relay."""
    _member(scene.here, scene.there)
    used, peer = _used(scene.here), scene.here.config["peer"][0]
    used["public_key"], peer["public_key"] = peer["public_key"], used["public_key"]
    await _checked_start(scene)


async def firewall(scene: Scene) -> None:
    """Datagrams to the relay `here` are dropped when they arrive."""
    need(os.geteuid() == 0, "root, for network namespaces")
    _member(scene.there, scene.here)
    scene.namespace(
        f"table inet test {{ chain in {{ type filter hook input priority 0; udp dport {scene.here.sockaddr[1]} drop;"
        "\n}\n}"
    )
    await _checked_start(scene)


async def unknown_name(scene: Scene) -> None:
    """No resolver knows the name of the relay."""
    _member(scene.here, scene.there)
    _used(scene.here)["addresses"] = ["no-such-host.invalid:5790"]
    await _checked_start(scene)


async def one_end(scene: Scene) -> None:
    """Only the file of `there` has the [[relay]]."""
    relay = _relay_of_both(scene)
    del scene.here.config["relay"]
    await scene.start(relay, scene.here, scene.there)


async def peer_key(scene: Scene) -> None:
    """`here` has a random key for `there`."""
    relay = _relay_of_both(scene)
    scene.here.config["peer"][0]["public_key"] = _key()
    await scene.start(relay, scene.here, scene.there)


def _relay_of_both(scene: Scene) -> DaemonProcess:
    """A third daemon, by which the two can be peers."""
    scene.here.add_peer(scene.there, [])
    scene.there.add_peer(scene.here, [])
    return relay_for(scene.stage, scene.here, scene.there, name=f"m{scene.row}-vps")


async def port_in_use(scene: Scene) -> None:
    """Another process has the port of the relay."""
    _member(scene.there, scene.here)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(scene.here.sockaddr)
        scene.command = await said_by_process("relay", "--config", str(scene.here.write_config()))


async def file_of_a_member(scene: Scene) -> None:
    """`uavlinkd relay` with the file of a vehicle."""
    _member(scene.here, scene.there)
    scene.command = await said_by_process("relay", "--config", str(scene.here.write_config()))
