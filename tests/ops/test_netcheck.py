"""``uavlinkd netcheck``: what it concludes from views and tokens of relays. ``ping``: what it prints of each path."""

from __future__ import annotations

import re
import time
from typing import Any

import pytest

from tests.test_readmes import ROOT
from uavlinkd.ops.netcheck import (
    BLOCKED,
    BY_TLS,
    INTERVAL_S,
    NO_RELAY,
    ONE_PORT,
    ONE_RELAY,
    Filtered,
    Mapped,
    behaviours,
    folded,
    ping,
    report,
)
from uavlinkd.system.error_meanings import WEB_ERRORS

PRIVATE, PUBLIC, OTHER = "192.168.1.5:5790", "203.0.113.7:40001", "203.0.113.7:40002"


def view(relay: str, at: str, seen_as: str, **more: Any) -> dict[str, Any]:
    """How a relay sees a socket."""
    return {"relay": relay, "relay_address": at, "socket": 0, "network": None, "seen_as": seen_as, **more}


def shown(passes: bool | None, **more: Any) -> dict[str, Any]:
    """Whether a token of a relay arrived at a socket."""
    result = {"relay": "one", "relay_address": "a:1", "socket": 0, "network": None, "other_port_passes": passes}
    return result | more


def answer(*views: dict[str, Any], state: str = "up", filtering: tuple[dict[str, Any], ...] = ()) -> dict[str, Any]:
    """A daemon's answer with these views, of the relays that they name."""
    relays = {
        name: {
            "state": state,
            "round_trip_s": 0.0234,
            "addresses": [f"{name}.example.org:5790"],
            "unresolved": [],
            "is_udp": state == "up",
            "silent": [],
        }
        for name in ("one", "two")
    }
    return {
        "relays": relays,
        "views": list(views),
        "filtering": list(filtering),
        "candidates": [PUBLIC, PRIVATE],
        "other": "",
        "is_udp_blocked": False,
        "web": {},
        "is_relay": False,
        "own": [PRIVATE],
    }


@pytest.mark.parametrize(
    ("seen", "mapped"),
    [
        ({"a:1": PRIVATE}, Mapped.NO_NAT),
        ({"a:1": PRIVATE, "b:1": PRIVATE}, Mapped.NO_NAT),
        ({"a:1": PUBLIC}, Mapped.UNKNOWN),
        ({"a:1": PUBLIC, "b:1": PUBLIC}, Mapped.INDEPENDENT),
        ({"a:1": PUBLIC, "a:2": PUBLIC}, Mapped.NOT_BY_PORT),
        ({"a:1": PUBLIC, "a:2": PUBLIC, "b:1": PUBLIC}, Mapped.INDEPENDENT),
        ({"a:1": PUBLIC, "b:1": OTHER}, Mapped.BY_EITHER),
        ({"a:1": PUBLIC, "a:2": PUBLIC, "b:1": OTHER}, Mapped.BY_ADDRESS),
        ({"a:1": PUBLIC, "a:2": OTHER}, Mapped.BY_PORT),
        ({"[2001:db8::1]:1": PUBLIC, "[2001:db8::1]:2": OTHER}, Mapped.BY_PORT),
        ({"[2001:db8::1]:1": PUBLIC, "[2001:db8::2]:1": OTHER}, Mapped.BY_EITHER),
    ],
)
def test_mapping_follows_from_the_views(seen: dict[str, str], mapped: Mapped) -> None:
    """Two ports of one relay show whether the NAT maps by port; only two hosts show whether it maps by address."""
    views = [view("one", at, seen_as) for at, seen_as in seen.items()]
    assert list(behaviours(answer(*views))) == [(None, mapped, Filtered.UNKNOWN)]


@pytest.mark.parametrize(
    ("passes", "filtered"),
    [
        ((), Filtered.UNKNOWN),
        ((None,), Filtered.UNKNOWN),
        ((False, None), Filtered.BY_PORT),
        ((True, None), Filtered.NOT_BY_PORT),
        ((False, True), Filtered.NOT_BY_PORT),
    ],
)
def test_filtering_follows_from_the_tokens(passes: tuple[bool | None, ...], filtered: Filtered) -> None:
    """One that arrives weighs more than one that does not, which a firewall of the relay may have dropped."""
    results = tuple(shown(one) for one in passes)
    assert list(behaviours(answer(view("one", "a:1", PRIVATE), filtering=results))) == [
        (None, Mapped.NO_NAT, filtered)
    ]


@pytest.mark.parametrize("state", ["up", "down"])
def test_report_fits_80_columns(state: str) -> None:
    """Addresses stay whole, folded lines begin below the text, and a sentence without a label is not indented."""
    place = "[2001:db8:1111:2222:3333:4444:5555:6666]:40001"
    lines = list(report(answer(view("one", place, place, network="lte"), state=state)))
    printed = [line for text in lines for line in folded(text).splitlines()]
    assert max(map(len, printed)) <= 80
    assert " ".join(" ".join(printed).split()) == " ".join(" ".join(lines).split())
    assert any(line.startswith(" " * 13) and place in line for line in printed) is (state == "up")
    rest = printed[printed.index("candidates   203.0.113.7:40001, 192.168.1.5:5790") + 1 :]
    assert not [line for line in rest if line.startswith(" ")]


@pytest.mark.parametrize(
    ("error", "line"),
    [
        ("", "connects"),
        ("http_404", "a web server answers there, but not for this path"),
        ("http_403", "a web server, proxy or login page there refuses (http_403): log in to this network"),
        ("tls", "no TLS at this port, or a firewall that inspects TLS ends it (tls): compare the URL"),
        ("proxy_407", "the proxy wants a name and password (proxy_407): write HTTPS_PROXY=http://USER"),
        ("proxy_403", "the proxy refuses to connect to the relay (proxy_403): its owner"),
        ("ECONNREFUSED", "no process listens there now (ECONNREFUSED): start it, or correct the port"),
    ],
)
def test_each_url_of_a_relay_is_tried(error: str, line: str) -> None:
    web = {"wss://one:443/uavlink": {"error": error, "proxy": "10.0.0.1:3128" if error == "proxy_407" else ""}}
    lines = list(report({**answer(), "web": web}))
    (found,) = [text for text in lines if text.startswith("TLS ")]
    through = " through the proxy 10.0.0.1:3128" if error == "proxy_407" else ""
    assert found.startswith(f"TLS          wss://one:443/uavlink{through}: {line}")


def test_reasons_by_tls_are_a_closed_list() -> None:
    """Each reason of a member has a meaning and a remedy, which ``status`` shows too, and a row in README.md."""
    sources = [ROOT / "uavlinkd/endpoints" / f"{name}.py" for name in ("web_connect", "web_stream", "tls_channel")]
    written = r'(?:lose\(|lose, |return |fault = |else |WebConnectError\()f?"([a-z0-9_]+)'
    reasons = {reason for path in sources for reason in re.findall(written, path.read_text())}
    of_relays, of_daemon = {"page", "wrong_path"}, {"finished"}
    elsewhere = {"http_404", "proxy_407", "TimeoutError", "silent", "ECONNRESET", "EPIPE", "ETIMEDOUT"}
    assert reasons - of_relays - of_daemon | elsewhere == set(WEB_ERRORS)
    assert all(": " in meaning for meaning in WEB_ERRORS.values())
    table = (ROOT / "uavlinkd/ops/README.md").read_text().partition("| reason | meaning | remedy |")[2]
    rows = [line.split(" | ")[0] for line in table.partition("\n\n")[0].splitlines()]
    names = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert names - {"ECONNREFUSED"} == set(WEB_ERRORS)


def silent(at: str, icmp: str = "", *, host_answers: bool = False) -> dict[str, Any]:
    """An address of a relay without an answer."""
    return {"address": at, "icmp": icmp, "host_answers": host_answers}


ONE, TWO = "198.51.100.1:5790", "[2001:db8::2]:5790"
CHECK = "`nc -zvw3 {} 22`"


@pytest.mark.parametrize(
    ("down", "silences", "facts", "headline", "shown", "advice"),
    [
        ("", {}, {}, "gets out: 2 of 2 relays answer", "one: up, 23 ms", ()),
        (
            *("one two", {"one": [silent(ONE)], "two": [silent(TWO)]}, {"is_udp_blocked": True}),
            "is probably blocked here: none of 2 relays on different hosts answers",
            *(f"one: waiting; no answer at {ONE}", (BLOCKED, CHECK.format("198.51.100.1"))),
        ),
        (
            *(
                "one two",
                {"one": [silent(ONE, "ECONNREFUSED")], "two": [silent(TWO, "EACCES")]},
                {},
                "gets no answer: 0 of 2 relays answer",
            ),
            *(f"one: waiting; no answer at {ONE} (ICMP: no process listens there)", (NO_RELAY,)),
        ),
        (
            *("one two", {"two": [silent(TWO)]}, {"other": "drone1 at 203.0.113.9:5790"}),
            "gets out: drone1 at 203.0.113.9:5790 answers directly, no relay does",
            *(f"two: waiting; no answer at {TWO}", (ONE_RELAY, CHECK.format("2001:db8::2"))),
        ),
        (
            *(
                "two",
                {"one": [silent(ONE)], "two": [silent(TWO)]},
                {},
                "gets out: 1 of 2 relays answer; two alone does not",
            ),
            *(f"two: waiting; no answer at {TWO}", (ONE_RELAY, CHECK.format("2001:db8::2"))),
        ),
        (
            *("", {"one": [silent(ONE, host_answers=True)]}, {}),
            f"gets out: 2 of 2 relays answer; one port does not: {ONE}",
            *(f"one: up, 23 ms; no answer at {ONE}", (ONE_PORT,)),
        ),
    ],
)
def test_headline_and_advice_name_the_case(
    down: str,
    silences: dict[str, list[dict[str, Any]]],
    facts: dict[str, Any],
    headline: str,
    shown: str,
    advice: tuple[str, ...],
) -> None:
    """UDP at all, the relays, one relay, one port: in the headline, and in the advice at the end."""
    result = answer() | facts
    for name in down.split():
        result["relays"][name] |= {"state": "waiting", "is_udp": False}
    for name, addresses in silences.items():
        result["relays"][name]["silent"] = addresses
    lines = list(report(result))
    assert lines[0] == f"UDP          {headline}"
    assert f"relay        {shown}" in lines
    (last,) = [number for number, line in enumerate(lines) if line.startswith("candidates")]
    said = " ".join(lines[last + 1 :])
    assert all(text in said for text in advice)
    given = [text for text in (BLOCKED, NO_RELAY, ONE_RELAY, ONE_PORT) if text in said]
    assert len(given) == len(advice[:1])
    assert max(len(part) for line in lines for part in folded(line).splitlines()) <= 80


def test_relays_that_answer_by_tls_alone() -> None:
    result = answer()
    for relay in result["relays"].values():
        relay["is_udp"] = False
    lines = list(report(result))
    assert lines[0] == "UDP          gets no answer: 0 of 2 relays answer"
    assert "relay        one: up by TLS, 23 ms" in lines
    assert lines[-1] == BY_TLS


def test_a_name_without_an_address_is_no_relay_that_is_off() -> None:
    """Its line names the cause. Advice about firewalls would contradict it."""
    result = answer()
    result["relays"]["one"] |= {"state": "waiting", "is_udp": False, "unresolved": ["one.example.org"]}
    lines = list(report(result))
    assert (
        "relay        one: waiting; one.example.org has no address now: see `getent hosts one.example.org`" in lines
    )
    assert lines[-1].startswith("candidates")


DIRECT: dict[str, Any] = {
    "address": "203.0.113.7:5790",
    "relay": None,
    "network": "lte",
    "answered_s": 1.02,  # at once, an interval ago
    "round_trip_s": 0.0234,
    "reason": "answered",
    "loss_in": 0.0,
    "loss_out": 0.02,
    "carries": ["critical", "stream", "bulk"],
}
RELAYED = {
    **DIRECT,
    "number": 1,
    "address": "relayed via vps",
    "relay": "vps",
    "relay_address": "198.51.100.2:5790",
    "network": None,
    "carries": ["critical"],
}
SILENT = {**RELAYED, "answered_s": 3.0, "carries": []}
BY_TLS_BEFORE = {**SILENT, "network": "TLS", "reason": "closed"}


@pytest.mark.parametrize(
    ("paths", "is_answered"), [([DIRECT, SILENT], True), ([SILENT], False), ([], False), ([BY_TLS_BEFORE], False)]
)
def test_each_question_has_a_line_for_each_path(
    paths: list[dict[str, Any]],
    is_answered: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The answers to the first question are shown a second later."""
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)
    assert ping(lambda: {"paths": paths}, 3) is is_answered
    lines = capsys.readouterr().out.splitlines()
    assert slept == [INTERVAL_S] * 3
    assert len(lines) == 3 * max(1, len(paths))
    assert lines[-1].startswith("3: ")
    if len(paths) == 2:
        assert lines[:2] == [
            "1: direct to 203.0.113.7:5790 on lte, 23.4 ms, loss 0 % in, 2 % out, carries critical and stream and"
            " bulk",
            "1: relayed via vps, no answer, loss 0 % in, 2 % out, carries no frames",
        ]
    if paths == [BY_TLS_BEFORE]:
        assert lines[0].startswith("1: relayed via vps on TLS, not connected, loss")
