"""MAVLink URLs: the five forms, and what to write for those of other clients."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.endpoints.url import EndpointKind, NetworkUrl, SerialUrl, UrlError, parse_url
from uavlinkd.system.addresses import Address


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("udpin:127.0.0.1:14550", NetworkUrl(EndpointKind.UDPIN, Address("127.0.0.1", 14550))),
        ("udpin://127.0.0.1:14550", NetworkUrl(EndpointKind.UDPIN, Address("127.0.0.1", 14550))),
        ("udpin://127.0.0.1:14550/", NetworkUrl(EndpointKind.UDPIN, Address("127.0.0.1", 14550))),
        ("udpin:localhost:14550", NetworkUrl(EndpointKind.UDPIN, Address("127.0.0.1", 14550))),
        ("udpin:0.0.0.0:14550", NetworkUrl(EndpointKind.UDPIN, Address("0.0.0.0", 14550))),
        ("udpin:[::1]:14550", NetworkUrl(EndpointKind.UDPIN, Address("::1", 14550))),
        ("udpout:10.0.0.5:14540", NetworkUrl(EndpointKind.UDPOUT, Address("10.0.0.5", 14540))),
        ("udpout://tablet.local:14550", NetworkUrl(EndpointKind.UDPOUT, Address("tablet.local", 14550))),
        ("tcp:127.0.0.1:5760", NetworkUrl(EndpointKind.TCP, Address("127.0.0.1", 5760))),
        ("tcpin://127.0.0.1:5760", NetworkUrl(EndpointKind.TCPIN, Address("127.0.0.1", 5760))),
        ("serial:/dev/ttyACM0:57600", SerialUrl("/dev/ttyACM0", 57600)),
        ("serial:///dev/ttyACM0:921600", SerialUrl("/dev/ttyACM0", 921600)),
        (
            "serial:/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0:115200",
            SerialUrl("/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0", 115200),
        ),
    ],
)
def test_url_is_read(text: str, url: NetworkUrl | SerialUrl) -> None:
    """Both ``:`` and ``://`` are taken; the usual form of the result means the same."""
    assert parse_url(text) == url
    assert parse_url(str(url)) == url


@pytest.mark.parametrize(
    ("text", "says"),
    [
        # pymavlink and MAVProxy
        ("udp:127.0.0.1:14550", "write udpin:127.0.0.1:14550 to listen there or udpout:127.0.0.1:14550 to send"),
        ("udpbcast:192.168.1.255:14550", "udpout:HOST:PORT for each receiver"),
        ("mcast:", "udpout:HOST:PORT for each receiver"),
        ("/dev/ttyACM0,57600", "write serial:/dev/ttyACM0:57600"),
        ("/dev/ttyACM0", "write serial:/dev/ttyACM0:57600"),
        ("127.0.0.1:14550", "write udpin:127.0.0.1:14550 to listen or udpout:127.0.0.1:14550"),
        ("[::1]:14550", "write udpin:[::1]:14550"),
        ("14550", "write udpin:127.0.0.1:14550"),
        ("ws://127.0.0.1:8088", "ws: is not supported"),
        # MAVSDK
        ("udp://:14540", "write udpin:14540"),
        ("tcpout://127.0.0.1:5760", "write tcp:127.0.0.1:5760"),
        ("serial_flowcontrol:///dev/ttyS0:57600", "write serial:/dev/ttyS0:57600"),
        # mavp2p
        ("udps:0.0.0.0:14550", "write udpin:0.0.0.0:14550"),
        ("udpc:10.0.0.5:14550", "write udpout:10.0.0.5:14550"),
        ("udpb:192.168.1.255:14550", "udpout:HOST:PORT for each receiver"),
        ("tcps:0.0.0.0:5760", "write tcpin:0.0.0.0:5760"),
        ("tcpc:10.0.0.5:5760", "write tcp:10.0.0.5:5760"),
        # mavlink-server
        ("udpserver://0.0.0.0:14550", "write udpin:0.0.0.0:14550"),
        ("udpclient://10.0.0.5:14550", "write udpout:10.0.0.5:14550"),
        ("serial:///dev/ttyACM0?baudrate=57600", "write serial:/dev/ttyACM0:57600"),
        # MAVROS
        ("/dev/ttyACM0:921600", "write serial:/dev/ttyACM0:921600"),
        ("udp://:14540@127.0.0.1:14580", "not BIND@REMOTE"),
        ("udpin://:14540@127.0.0.1:14580", "not BIND@REMOTE"),
        ("udp-b://:14550@", "not BIND@REMOTE"),
        ("tcp-l://0.0.0.0:5760", "write tcpin:0.0.0.0:5760"),
        ("serial-hwfc:///dev/ttyS0:57600", "write serial:/dev/ttyS0:57600"),
        # slips
        ("UDPIN:127.0.0.1:14550", "write udpin:127.0.0.1:14550"),
        ("udpin:14550", "write udpin:127.0.0.1:14550"),
        ("udpin::14550", "write udpin:127.0.0.1:14550"),
        ("udpin:127.0.0.1", "after udpin: the address has no port: write 127.0.0.1:5790"),
        ("udpin:127.0.0.1:99999", "port from 1 to 65535"),
        ("udpin:autopilot.local:14550", "numeric"),
        ("udpin:127.0.0.1:14550/?ids=1,1", "more than host and port"),
        ("udpout:0.0.0.0:14550", "write udpout:127.0.0.1:14550"),
        ("tcp:[::]:5760", "write tcp:127.0.0.1:5760"),
        ("serial:/dev/ttyACM0", "needs a device and a baud rate"),
        ("serial:/dev/ttyACM0,57600", "write serial:/dev/ttyACM0:57600"),
        ("serial:ttyACM0:57600", "needs a device and a baud rate"),
        ("serial:COM3:57600", "Windows"),
        ("serial:/dev/ttyACM0:57", "from 300 to"),
        ("serial:/dev/ttyACM0:99999999", "from 300 to"),
        ("autopilot", "is not a MAVLink URL"),
        ("bluetooth:00-11", "no known scheme"),
        ("", "is not a MAVLink URL"),
    ],
)
def test_other_spellings_are_refused_with_ours(text: str, says: str) -> None:
    """Whatever another client would call the endpoint, the message says how it is written here."""
    with pytest.raises(UrlError) as caught:
        parse_url(text)
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("text", "listens", "exposed"),
    [
        ("udpin:127.0.0.1:1", True, False),
        ("udpin:127.9.9.9:1", True, False),
        ("udpin:[::1]:1", True, False),
        ("udpin:0.0.0.0:1", True, True),
        ("udpin:[::]:1", True, True),
        ("tcpin:192.168.1.2:1", True, True),
        ("udpout:127.0.0.1:1", False, False),
        ("udpout:192.168.1.2:1", False, True),
        ("tcp:autopilot.local:1", False, True),
        ("serial:/dev/ttyACM0:57600", False, False),
    ],
)
def test_exposure_is_anything_but_loopback_and_wire(text: str, listens: bool, exposed: bool) -> None:
    """A name counts as the network: where it resolves to is another's decision."""
    url = parse_url(text)
    assert (url.listens, url.is_exposed) == (listens, exposed)


_PIECES = st.lists(
    st.sampled_from(
        ["udpin", "udp", "serial", "tcp-l", ":", "//", "/dev/x", "@", "?", ",", "[", "]", "::1", "9", "\n", "é"]
    )
    | st.text(max_size=3),
    max_size=8,
)


@given(_PIECES.map("".join))
def test_any_text_is_a_url_or_a_url_error(text: str) -> None:
    """No text makes the parser raise anything else, what it takes it writes back, and messages are one line."""
    try:
        url = parse_url(text)
    except UrlError as error:
        assert "\n" not in str(error)  # noqa: PT017  what is tested is the message of whatever fails
        return
    assert parse_url(str(url)) == url
