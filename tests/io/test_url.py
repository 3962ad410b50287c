"""MAVLink URLs: the five forms, and what to write for those of other clients."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.io.url import EndpointKind, NetworkUrl, SerialUrl, UrlError, parse_url
from uavlinkd.system.addresses import Address


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("udpin:127.0.0.1:14550", NetworkUrl(EndpointKind.UDPIN, Address("127.0.0.1", 14550))),
        ("udpin://127.0.0.1:14550", NetworkUrl(EndpointKind.UDPIN, Address("127.0.0.1", 14550))),
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
        ("udp:127.0.0.1:14550", "write udpin:127.0.0.1:14550 to listen there or udpout:127.0.0.1:14550 to send"),
        ("/dev/ttyACM0", "write serial:/dev/ttyACM0:57600"),
        ("127.0.0.1:14550", "write udpin:127.0.0.1:14550 to listen or udpout:127.0.0.1:14550"),
        ("14550", "write udpin:127.0.0.1:14550"),
        ("ws://127.0.0.1:8088", "no known scheme"),
        ("udp://:14540", "write udpin:14540"),
        ("/dev/ttyACM0:921600", "write serial:/dev/ttyACM0:921600"),
        ("udp://:14540@127.0.0.1:14580", "not BIND@REMOTE"),
        ("UDPIN:127.0.0.1:14550", "write udpin:127.0.0.1:14550"),
        ("udpin:127.0.0.1", "after udpin: the address has no port: write 127.0.0.1:5790"),
        ("udpin:127.0.0.1:99999", "port from 1 to 65535"),
        ("udpin:autopilot.local:14550", "numeric"),
        ("udpin:127.0.0.1:14550/?ids=1,1", "more than host and port"),
        ("udpout:0.0.0.0:14550", "write udpout:127.0.0.1:14550"),
        ("serial:/dev/ttyACM0", "needs a device and a baud rate"),
        ("serial:/dev/ttyACM0,57600", "write serial:/dev/ttyACM0:57600"),
        ("serial:/dev/ttyACM0:57", "from 300 to"),
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
