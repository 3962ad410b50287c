"""`uavlinkd status` for people."""

from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console

from uavlinkd.ops.log import DISTURBANCES
from uavlinkd.ops.status_screen import all_up, render_status


def peer(state: str, **facts: object) -> dict[str, Any]:
    """What the daemon says of one."""
    return {
        "state": state,
        "heard_s": 12.3,
        "round_trip_s": 0.1234,
        "freshness_unverified_s": None,
        "loss_in": 0.12,
        "loss_out": 1.0,
        "bytes_in_s": 123456.0,
        "bytes_out_s": 123456.0,
        "path": "203.0.113.255:65535",
        "session": {"suite": "x25519-mlkem768", "mode": "authenticated"},
        "handshake_s": 99.9,
        "drops": {},
        "malformed": {},
        "waiting_dropped": {},
        "refused": {},
        **dict.fromkeys(DISTURBANCES, 0),
        **facts,
    }


def shown(peers: dict[str, dict[str, Any]], width: int, recording: dict[str, Any] | None = None) -> str:
    """The screen."""
    nothing: dict[str, Any] = {"endpoints": {}, "drops": {}, "send_failures": {}, "stale": {}}
    status = {"name": "drone0", "peers": peers, "recording": recording, **nothing}
    file = io.StringIO()
    Console(file=file, width=width).print(render_status(status))
    return file.getvalue()


@pytest.mark.parametrize("name", ["drone1", "ground-station"])
def test_all_of_it_is_read_on_eighty_columns(name: str) -> None:
    """On the narrowest terminal, and in a pipe, no figure and no reason is cut."""
    drops = {"replayed": 1234567, "bad_tag": 12, "late": 1}
    text = shown({name: peer("waiting", drops=drops)}, 80)
    assert max(map(len, text.splitlines())) <= 80
    assert "\u2026" not in text
    path = "203.0.113.255:65535"
    for part in (
        name,
        "waiting",
        "12.3 s",
        "123.4 ms",
        "12/100 %",
        "123.5 kB/s",
        path,
        "x25519-mlkem768",
        "99.9 s",
    ):
        assert part in text
    assert f"{name} dropped: 1,234,567 replayed, 12 bad_tag, 1 late" in " ".join(text.split())


@pytest.mark.parametrize("path", ["[fd00::2]:5790", "[fe80::1%2]:5790", "[2001:db8:a::1]:5790"])
def test_an_ipv6_address_is_no_markup(path: str) -> None:
    """Brackets and colons are read as they are."""
    assert path in shown({"drone1": peer("up", path=path)}, 80)


def test_unverified_freshness_is_shown_with_its_meaning() -> None:
    """The time, and what happens to commands; nothing of it while freshness is verified."""
    text = " ".join(shown({"drone1": peer("up", freshness_unverified_s=12.5)}, 80).split())
    assert "drone1 freshness unverified for 12.5 s" in text
    assert "held and dropped" in text
    assert "freshness" not in shown({"drone1": peer("up")}, 80)


def test_a_hidden_frame_is_shown_before_reasons_with_greater_counts() -> None:
    """A captured member cannot push it off the screen by other refused frames."""
    loud = {"foreign_system": 900, "message_not_allowed": 800, "rate_limited": 700}
    refused = {"in": {"HEARTBEAT": loud, "HOME_POSITION": {"hidden_frame": 1}}}
    text = " ".join(shown({"drone1": peer("up", refused=refused)}, 80).split())
    assert "drone1 dropped: 1 hidden_frame, 900 foreign_system, 800 message_not_allowed, \u2026" in text


def test_a_recording_that_failed_is_told() -> None:
    """Where nothing is kept, who looks sees it."""
    recording = {"is_recording": False, "failures": {"EROFS": 7}}
    assert "nothing is recorded now: 7 EROFS" in shown({"drone1": peer("up")}, 80, recording)
    assert "recorded" not in shown({"drone1": peer("up")}, 80, recording | {"is_recording": True})


def test_who_is_not_up_stands_first() -> None:
    """What is broken is what is looked for."""
    peers = {"alpha": peer("up"), "zulu": peer("lost")}
    text = shown(peers, 100)
    assert text.index("zulu") < text.index("alpha")
    assert "1 of 2 peers up" in text
    assert not all_up({"peers": peers})
    assert all_up({"peers": {"alpha": peer("up")}})
    assert not all_up({"peers": {}})
