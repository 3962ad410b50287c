"""How the mistakes of two running daemons are made."""

from __future__ import annotations

import os
import pty
import signal
import socket
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.mistakes.scene import WITHOUT_RIGHTS, Frames, Scene, checked, said_by_process
from tests.needs import need
from tests.processes.frames import command_long, ground_heartbeat, heartbeat, numbered
from tests.processes.members import CertifiedFleet
from tests.processes.process import DaemonProcess
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.config import keys
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.system.base64_text import to_base64

ANOTHER_USER = 65534
"""Any user that is not the daemon's."""
_ONE: dict[str, Any] = {"role": "swarm-member", "system_ids": [1]}
_TWO: dict[str, Any] = {"role": "swarm-member", "system_ids": [2]}


def _peer(daemon: DaemonProcess) -> dict[str, Any]:
    section: dict[str, Any] = daemon.config["peer"][0]
    return section


def _vehicle(system: int) -> Frames:
    return lambda number: [heartbeat(system, seq=number), numbered(number, system)]


async def _linked(scene: Scene) -> None:
    await scene.start()
    await scene.here.until_linked()
    await scene.there.until_linked()


async def _checked_start(scene: Scene) -> None:
    scene.check = checked(scene.here)
    await scene.start()


async def _wrong_key(scene: Scene, key: str) -> None:
    scene.introduce()
    _peer(scene.here)["public_key"] = key
    await _checked_start(scene)


async def other_key(scene: Scene) -> None:
    """`here` has a random key for `there`."""
    await _wrong_key(scene, keys.public_key_text(keys.generate_private_key()))


async def private_key(scene: Scene) -> None:
    """`here` has the private key of `there`."""
    await _wrong_key(scene, scene.there.private_key)
    # It is in the file on purpose: the harness looks for it in every output, so replace it there.
    scene.stage.secrets.remove(scene.there.private_key)


async def wrong_port_here(scene: Scene) -> None:
    """`here` calls a port where no process listens."""
    scene.introduce()
    _peer(scene.here)["addresses"] = [f"127.0.0.1:{free_port()}"]
    await _linked(scene)


async def wrong_port_both(scene: Scene) -> None:
    """Both do."""
    scene.introduce()
    for daemon in (scene.here, scene.there):
        _peer(daemon)["addresses"] = [f"127.0.0.1:{free_port()}"]
    await _checked_start(scene)


async def port_in_use(scene: Scene) -> None:
    """Another process has the port."""
    scene.introduce()
    host, port = scene.here.sockaddr
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((host, port))
        scene.command = await said_by_process("run", "--config", str(scene.here.write_config()))


async def unknown_name(scene: Scene) -> None:
    """No resolver knows the name."""
    scene.introduce()
    for daemon in (scene.here, scene.there):
        _peer(daemon)["addresses"] = ["no-such-host.invalid:5790"]
    await _checked_start(scene)


async def serial_missing(scene: Scene) -> None:
    """There is no such device."""
    scene.introduce()
    scene.here.add_endpoint("autopilot", "serial:/dev/no-such-device:57600")
    await _checked_start(scene)


async def serial_forbidden(scene: Scene) -> None:
    """The device belongs to another user. Root without its right to ignore that is any user."""
    need(os.geteuid() == 0, "root")
    scene.introduce()
    master, slave = pty.openpty()
    device = os.ttyname(slave)
    os.chown(device, ANOTHER_USER, ANOTHER_USER)
    os.chmod(device, 0o600)
    scene.descriptors += [master, slave]
    scene.here.add_endpoint("autopilot", f"serial:{device}:57600")
    scene.here.launcher = WITHOUT_RIGHTS
    path = str(scene.here.write_config())
    scene.check = await said_by_process("check", "--config", path, launcher=WITHOUT_RIGHTS)
    await scene.start()


async def families(scene: Scene) -> None:
    """`listen` has IPv4 only, the peer IPv6 only."""
    scene.introduce()
    for daemon in (scene.here, scene.there):
        _peer(daemon)["addresses"] = ["[2001:db8::2]:5790"]
    await _checked_start(scene)


async def psk(scene: Scene) -> None:
    """Only `here` has a PSK."""
    scene.here.add_peer(scene.there, [scene.there.address], scene.stage.psk())
    scene.there.add_peer(scene.here, [scene.here.address])
    await _checked_start(scene)


async def suites(scene: Scene) -> None:
    """No suite is in both lists."""
    scene.introduce(there={"suites": ["mlkem768"]})
    await _checked_start(scene)


async def copied_card(scene: Scene) -> None:
    """A third daemon has the key of `there`, and both call `here`."""
    scene.introduce()
    await scene.start(scene.here, scene.there, scene.clone(scene.there))


async def input_dropped(scene: Scene) -> None:
    """Datagrams to `there` are dropped when they arrive."""
    need(os.geteuid() == 0, "root, for network namespaces")
    scene.introduce()
    port = scene.there.sockaddr[1]
    scene.namespace(
        f"table inet test {{ chain in {{ type filter hook input priority 0; udp dport {port} drop;\n}}\n}}"
    )
    await _checked_start(scene)


async def output_dropped(scene: Scene) -> None:
    """Datagrams to `there` are refused when they are sent."""
    need(os.geteuid() == 0, "root, for network namespaces")
    scene.introduce()
    port = scene.there.sockaddr[1]
    scene.namespace(
        f"table inet test {{ chain out {{ type filter hook output priority 0; udp dport {port} drop;\n}}\n}}"
    )
    await _checked_start(scene)


async def listen_elsewhere(scene: Scene) -> None:
    """TEST-NET-1 is on no machine."""
    scene.introduce()
    scene.here.config["listen"] = ["192.0.2.7:5790"]
    await _checked_start(scene)


async def no_addresses(scene: Scene) -> None:
    """Neither can initiate."""
    scene.introduce()
    for daemon in (scene.here, scene.there):
        _peer(daemon)["addresses"] = []
    await _checked_start(scene)


async def wrong_system(scene: Scene) -> None:
    """The autopilot sends as system 1, its file says 2."""
    scene.introduce(there={"role": "vehicle", "system_ids": [2]}, here={"role": "operator", "system_ids": [255]})
    into = scene.here.add_endpoint("autopilot")
    scene.there.add_endpoint("ground")
    await _linked(scene)
    await scene.send(into, _vehicle(1))


async def wrong_system_of_fleet(scene: Scene) -> None:
    """The same, and its endpoint says so too, as in a fleet."""
    scene.introduce(there={"role": "vehicle", "system_ids": [2]}, here={"role": "operator", "system_ids": [255]})
    into = scene.here.add_endpoint("autopilot", system_ids=[2])
    await _linked(scene)
    await scene.send(into, _vehicle(1))


async def roles(scene: Scene) -> None:
    """`here` is the vehicle, and says that the station is one."""
    scene.introduce(here={"role": "vehicle", "system_ids": [255]}, there={"role": "operator", "system_ids": [1]})
    vehicle, ground = scene.here.add_endpoint("autopilot"), scene.there.add_endpoint("ground")
    await _linked(scene)
    await scene.send(vehicle, _vehicle(1))
    await scene.send(ground, lambda number: [ground_heartbeat(number)])


async def bare_mavlink(scene: Scene) -> None:
    """An autopilot sends to the peers' port."""
    scene.introduce()
    await _linked(scene)
    await scene.send(scene.here.sockaddr, _vehicle(1))


async def closed_client(scene: Scene) -> None:
    """No process listens at the port of the ground station."""
    scene.introduce()
    scene.here.add_endpoint("ground", f"udpout:127.0.0.1:{free_port()}")
    into = scene.there.add_endpoint("autopilot")
    await _linked(scene)
    await scene.send(into, _vehicle(2))


async def reload(scene: Scene) -> None:
    """The running daemon gets an invalid file."""
    scene.introduce()
    await scene.start(scene.here)
    scene.here.config["link"]["tag_bits"] = 17
    scene.command = await said_by_process("reload", "--config", str(scene.here.write_config()))


async def without_restart(scene: Scene) -> None:
    """`here` has the new key of `there`, which still runs with its old one."""
    scene.introduce()
    await _linked(scene)
    _peer(scene.here)["public_key"] = keys.public_key_text(keys.generate_private_key())
    await said_by_process("reload", "--config", str(scene.here.write_config()))


async def other_user(scene: Scene) -> None:
    """The socket belongs to another user."""
    need(os.geteuid() == 0, "root")
    path = scene.here.folder / "other.sock"
    with socket.socket(socket.AF_UNIX) as sock:
        sock.bind(str(path))
        sock.listen()
        os.chown(path, ANOTHER_USER, ANOTHER_USER)
        path.chmod(0o600)
        scene.command = await said_by_process("status", "--socket", str(path), launcher=WITHOUT_RIGHTS)


async def killed(scene: Scene) -> None:
    """It left its control socket."""
    scene.introduce()
    await scene.start(scene.here)
    await scene.here.stop(signal.SIGKILL)
    scene.command = await said_by_process("status", "--config", str(scene.here.write_config()))
    await _linked(scene)


async def withheld(scene: Scene) -> None:
    """The operator arms over a link between swarm members."""
    scene.introduce(here={**_TWO}, there={**_ONE, "system_ids": [1, 255]})
    into = scene.here.add_endpoint("ground")
    scene.there.add_endpoint("autopilot")
    await _linked(scene)
    arm = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
    await scene.send(into, lambda number: [ground_heartbeat(number), command_long(arm, 255, (2, 1), seq=number)])


async def garbage(scene: Scene) -> None:
    """A console writes to the endpoint."""
    scene.introduce()
    into = scene.here.add_endpoint("autopilot")
    await _linked(scene)
    await scene.send(into, lambda number: [b"not MAVLink, but a console"])


async def listener(scene: Scene) -> None:
    """One heartbeat, then silence."""
    scene.introduce()
    into = scene.here.add_endpoint("autopilot")
    await _linked(scene)
    await scene.send(into, lambda number: [heartbeat(1)] if number == 0 else [])


async def no_client(scene: Scene) -> None:
    """Its autopilot is off."""
    scene.introduce()
    scene.here.add_endpoint("autopilot")
    await _linked(scene)


async def revoked_card(scene: Scene) -> None:
    """The vehicle `there` starts from a card that is older than its revocation, of which the station `here` knows."""
    fleet = CertifiedFleet()
    fleet.join(scene.here, MemberRole.OPERATOR, 255)
    fleet.join(scene.there, MemberRole.VEHICLE, 2, scene.here)
    fleet.revoke(scene.there.name)
    scene.here.config["fleet"]["bulletin"] = to_base64(fleet.bulletin)
    await scene.start()


async def no_control_socket(scene: Scene) -> None:
    """`status` has nothing to ask."""
    del scene.here.config["control_socket"]
    scene.command = await said_by_process("status", "--config", str(scene.here.write_config()))
