"""Each cause of a link that is down is found between real daemons, and a link that works has no finding."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Iterator

import pytest

from tests.daemon.frames import heartbeat
from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.daemon.test_reload import reload
from tests.daemon.udp import Client
from tests.link.found import findings, until_found, until_gone
from tests.needs import need
from uavlinkd.config import keys
from uavlinkd.core.crypto import KeyPair
from uavlinkd.core.indices import Indices
from uavlinkd.core.initiator import Initiator
from uavlinkd.core.path import Path
from uavlinkd.core.settings import PeerSettings
from uavlinkd.core.socket_facts import SocketFacts
from uavlinkd.lab.sim.loopback_ports import free_port, has_ipv6
from uavlinkd.ops.causes import Cause
from uavlinkd.ops.findings import Severity


def initiation(private_key: str, to: DaemonProcess) -> bytes:
    """An initiation to a daemon by the holder of a key."""
    settings = PeerSettings("target", keys.decode_key(to.public_key))
    identity = KeyPair(keys.decode_key(private_key))
    initiator = Initiator(settings, identity, Indices[object](os.urandom), os.urandom, SocketFacts(), 0.0)
    _, [(datagram, _)] = initiator.initiate(1, [Path(0, ("127.0.0.1", 1))], 1, 0.0)
    return datagram


async def send_until_found(
    client: Client, datagrams: Iterator[bytes], daemon: DaemonProcess, cause: Cause, name: str = ""
) -> None:
    """Send datagrams to a daemon's port for peers until it reports a cause."""

    async def send() -> None:
        for datagram in datagrams:
            client.send(datagram, daemon.sockaddr)
            await asyncio.sleep(0.05)

    task = asyncio.create_task(send())
    try:
        await until_found(daemon, cause, name)
    finally:
        task.cancel()


async def test_wrong_public_key() -> None:
    """One file has another key: that end shows the key that came, the other end the key that should be written."""
    async with Stage() as stage:
        a, b = stage.pair()
        a.config["peer"][0]["public_key"] = keys.public_key_text(keys.generate_private_key())
        await stage.start(a, b, linked=False)
        here = await until_found(a, Cause.WRONG_KEY_HERE, "drone1")
        assert b.public_key in here["text"]
        assert "`uavlinkd pubkey` at drone1" in here["remedy"]
        assert b.public_key not in here["remedy"]  # a key that arrived is never to be copied
        there = await until_found(b, Cause.WRONG_KEY_THERE, "drone0")
        assert b.public_key in there["remedy"]


async def test_wrong_public_key_without_addresses() -> None:
    """A ground station that only waits shows the key too, for the one vehicle that it waits for."""
    async with Stage() as stage:
        a, b = stage.daemon("drone0"), stage.daemon("drone1")
        a.add_peer(b, [])
        a.config["peer"][0]["public_key"] = keys.public_key_text(keys.generate_private_key())
        b.add_peer(a, [a.address])
        await stage.start(a, b, linked=False)
        assert b.public_key in (await until_found(a, Cause.WRONG_KEY_HERE, "drone1"))["text"]


async def test_wrong_psk() -> None:
    """Both ends say that the PSKs differ."""
    async with Stage() as stage:
        a, b = stage.daemon("drone0"), stage.daemon("drone1")
        a.add_peer(b, [b.address], stage.psk())
        b.add_peer(a, [a.address], stage.psk())
        await stage.start(a, b, linked=False)
        await until_found(a, Cause.WRONG_PSK, "drone1")
        await until_found(b, Cause.WRONG_PSK, "drone0")


async def test_wrong_psk_at_an_end_that_only_waits() -> None:
    """It knows only that its responses are not confirmed."""
    async with Stage() as stage:
        a, b = stage.daemon("drone0"), stage.daemon("drone1")
        a.add_peer(b, [], stage.psk())
        b.add_peer(a, [a.address], stage.psk())
        await stage.start(a, b, linked=False)
        assert "PSKs" in (await until_found(a, Cause.NOT_CONFIRMED, "drone1"))["remedy"]
        await until_found(b, Cause.WRONG_PSK, "drone0")


async def test_no_common_suite() -> None:
    """Both ends name the suite that the other offers."""
    async with Stage() as stage:
        a, b = stage.pair()
        b.config["link"]["suites"] = ["mlkem768"]
        await stage.start(a, b, linked=False)
        assert "offers the suite mlkem768" in (await until_found(a, Cause.NO_COMMON_SUITE, "drone1"))["text"]
        assert "offers the suite x25519;" in (await until_found(b, Cause.NO_COMMON_SUITE, "drone0"))["text"]


@pytest.mark.long
async def test_peers_that_are_not_there() -> None:
    """One daemon, and peers each of which is absent in another way: each has its own cause, and no other."""
    need(has_ipv6(), "IPv6 on loopback")
    async with Stage() as stage:
        a = stage.daemon("drone0")
        silent = await stage.client()
        closed = f"127.0.0.1:{free_port()}"
        expected = {
            Cause.NO_ANSWER: [str(silent)],
            Cause.NO_LISTENER: [closed],
            Cause.FAMILY_MISSING: ["[::1]:5790"],
            Cause.NOT_CONNECTING: [],
        }
        for number, addresses in enumerate(expected.values(), 1):
            a.add_peer(stage.daemon(f"drone{number}"), addresses)
        await stage.start(a, linked=False)
        await until_found(a, Cause.NOT_CONNECTING, "drone4")
        status = await a.status()
        for number, (cause, addresses) in enumerate(expected.items(), 1):
            causes = findings(status, "peer", f"drone{number}")
            assert set(causes) == {cause}
            assert all(address in causes[cause]["text"] for address in addresses)


async def test_listen_address_of_another_machine() -> None:
    """It is a fault while a link is down, and only a warning while all are up."""
    async with Stage() as stage:
        a, b = stage.pair()
        a.config["listen"].append(f"192.0.2.77:{free_port()}")
        await stage.start(a, linked=False)
        missing = await until_found(a, Cause.LISTEN_ADDRESS_MISSING)
        assert "192.0.2.77" in missing["text"]
        assert missing["severity"] == "fault"
        await stage.start(b)
        await a.until_linked()
        assert (await until_found(a, Cause.LISTEN_ADDRESS_MISSING))["severity"] == "warning"


async def test_key_that_was_replaced() -> None:
    """The file has a new key of the peer, and the peer still has the former one."""
    async with Stage() as stage:
        a, b = stage.pair()
        await stage.start(a, b)
        a.config["peer"][0]["public_key"] = keys.public_key_text(keys.generate_private_key())
        assert await reload(a) == []
        assert b.public_key in (await until_found(a, Cause.FORMER_KEY, "drone1"))["text"]
        a.config["peer"][0]["public_key"] = b.public_key
        assert await reload(a) == []
        await a.until_linked()
        await until_gone(a, Cause.FORMER_KEY)


@pytest.mark.long
async def test_copied_card_at_the_other_end() -> None:
    """Two machines with one private key: their sessions alternate. It is the first line."""
    async with Stage() as stage:
        a, b = stage.pair()
        copy = stage.daemon("drone2")
        copy.config |= {"name": "drone0", "peer": a.config["peer"]}
        for name in ("daemon.key", "drone1.psk"):
            (copy.folder / name).unlink(missing_ok=True)
            keys.write_secret_file(copy.folder / name, (a.folder / name).read_text().strip())
        await stage.start(a, b)
        await stage.start(copy, linked=False)
        two = await until_found(b, Cause.KEY_ON_TWO_MACHINES, "drone0")
        assert a.address in two["text"]
        assert copy.address in two["text"]
        assert (await b.status())["findings"][0]["cause"] == Cause.KEY_ON_TWO_MACHINES


async def test_own_key_on_another_machine() -> None:
    """An initiation that only the holder of this daemon's private key can make. Other keys do not hide it."""
    async with Stage() as stage:
        a = stage.daemon("drone0")
        stranger = await stage.client()
        await stage.start(a, linked=False)

        def many() -> Iterator[bytes]:
            yield initiation(a.private_key, a)
            for _ in range(20):
                yield initiation(keys.generate_private_key(), a)

        for datagram in many():
            stranger.send(datagram, a.sockaddr)
        finding = await until_found(a, Cause.OWN_KEY_ELSEWHERE)
        assert str(stranger) in finding["text"]
        assert "or an attacker replays an old recording" in finding["text"]
        assert finding["severity"] == Severity.SECURITY.name.lower()


async def test_forged_hints() -> None:
    """A sender on the peer's host adds hints while the link is down, and none while it is up."""
    async with Stage() as stage:
        a, b = stage.pair()
        attacker = await stage.client()
        await stage.start(a, linked=False)
        forged = keys.generate_private_key()
        await send_until_found(attacker, iter(lambda: initiation(forged, a), None), a, Cause.WRONG_KEY_HERE, "drone1")
        peer = findings(await a.status(), "peer", "drone1")
        assert keys.public_key_text(forged) not in peer[Cause.WRONG_KEY_HERE]["remedy"]
        assert Cause.NO_LISTENER in peer  # the genuine cause is still shown
        await stage.start(b)
        await a.until_linked()
        for _ in range(20):
            attacker.send(initiation(forged, a), a.sockaddr)
        await a.until(lambda status: status["drops"].get("unknown_peer", 0) > 0)
        await until_gone(a, Cause.WRONG_KEY_HERE)
        assert findings(await a.status(), "peer", "drone1") == {}


async def test_mavlink_at_the_port_for_peers() -> None:
    """The line names the sender."""
    async with Stage() as stage:
        a = stage.daemon("drone0")
        autopilot = await stage.client()
        await stage.start(a, linked=False)
        autopilot.send(b"\xfd\x09" + bytes(19), a.sockaddr)
        assert str(autopilot) in (await until_found(a, Cause.RAW_MAVLINK))["text"]


async def test_flood_of_initiations() -> None:
    """More than the daemon accepts: the status says so."""
    async with Stage() as stage:
        a = stage.daemon("drone0")
        attacker = await stage.client()
        await stage.start(a, linked=False)
        for _ in range(300):
            attacker.send(initiation(keys.generate_private_key(), a), a.sockaddr)
        assert "never block a peer's address" in (await until_found(a, Cause.UNDER_LOAD))["remedy"]


async def test_paused_daemon_and_unusable_recording() -> None:
    """Both are warnings about the daemon."""
    async with Stage() as stage:
        a, b = stage.pair()
        a.config["recording"] = {"folder": "flights", "min_free_bytes": 100_000}
        (a.folder / "flights").write_text("a file is in the way")
        into, autopilot = a.add_endpoint("autopilot"), await stage.client()
        await stage.start(a, b)
        autopilot.send(heartbeat(), into)
        await until_found(a, Cause.RECORDING_STOPPED)
        await a.send_signal(signal.SIGSTOP)
        await asyncio.sleep(4)
        await a.send_signal(signal.SIGCONT)
        assert " s, and dropped" in (await until_found(a, Cause.DAEMON_PAUSED))["text"]


async def test_healthy_link_has_no_finding() -> None:
    """Two linked daemons without endpoints have nothing to report."""
    async with Stage() as stage:
        a, b = stage.pair()
        await stage.start(a, b)
        assert (await a.status())["findings"] == (await b.status())["findings"] == []
