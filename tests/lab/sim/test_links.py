"""The simulator's own links: URLs, and real sockets on loopback."""

from __future__ import annotations

import random
import socket

import pytest

from tests.lab.sim.recorded import Collector, frames
from uavlinkd.lab.sim.links import MAX_CLIENTS, LinkError, LinkURL, parse_url


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("udpin:127.0.0.1:14550", LinkURL("udpin", "127.0.0.1", 14550)),
        ("udpin://127.0.0.1:14550", LinkURL("udpin", "127.0.0.1", 14550)),
        ("udpout:drone.local:14550", LinkURL("udpout", "drone.local", 14550)),
        ("udpin::14550", LinkURL("udpin", "0.0.0.0", 14550)),
        ("udpin:127.0.0.1:0", LinkURL("udpin", "127.0.0.1", 0)),
        ("udpout://10.0.0.1:14550/", LinkURL("udpout", "10.0.0.1", 14550)),
        ("udpin:[::1]:14550", LinkURL("udpin", "::1", 14550)),
    ],
)
def test_a_url_is_read(text: str, url: LinkURL) -> None:
    """Both spellings of every kind, and what is written back is read alike."""
    assert parse_url(text) == url
    assert parse_url(str(url)) == url


@pytest.mark.parametrize(
    "text",
    [
        *("", "udpin", "udpin:127.0.0.1", "udpin:127.0.0.1:", "udpin:127.0.0.1:x", "udpin:127.0.0.1:65536"),
        *("udpin:::1:14550", "udpout::14550", "udpout:127.0.0.1:0", "udp:127.0.0.1:14550"),
        *("serial:/dev/ttyS0:57600", "/dev/ttyACM0"),
    ],
)
def test_invalid_urls_are_refused_in_one_line(text: str) -> None:
    """The error quotes the URL, on one line."""
    with pytest.raises(LinkError) as failure:
        parse_url(text)
    assert repr(text) in str(failure.value)
    assert "\n" not in str(failure.value)


async def test_frames_pass_unchanged_in_both_directions() -> None:
    """What one end sends, the other collects byte for byte; a listener answers who called."""
    sent, answers = frames(20), frames(20, system_id=255)
    async with Collector("udpin:127.0.0.1:0") as ground:
        assert not ground.send(answers[0])
        async with Collector(f"udpout:127.0.0.1:{ground.address[1]}") as air:
            for frame in sent:
                assert air.send(frame)
            await ground.until(lambda: len(ground.frames) == len(sent))
            for frame in answers:
                assert ground.send(frame)
            await air.until(lambda: len(air.frames) == len(answers))
            assert (ground.frames, air.frames) == (sent, answers)


async def test_senders_without_mavlink_are_not_clients() -> None:
    """Noise does not make a sender a client, and a flood of clients evicts only the oldest."""
    async with Collector("udpin:127.0.0.1:0") as ground:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(random.Random(1).randbytes(400), ground.address)
            await ground.until(lambda: ground.link.receivers == 0)
            senders = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(MAX_CLIENTS + 5)]
            for sender in senders:
                sender.sendto(frames(1)[0], ground.address)
            await ground.until(lambda: len(ground.frames) == len(senders))
            assert ground.link.receivers == MAX_CLIENTS
            assert ground.link.split.garbage_bytes == 400
            for sender in senders:
                sender.close()
