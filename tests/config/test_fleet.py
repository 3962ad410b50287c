"""A fleet with an authority: the configuration of its members, and what a daemon refuses at its start."""

from __future__ import annotations

from base64 import b64decode
from dataclasses import replace
from pathlib import Path

import pytest

from tests.config.files import ENDPOINT, GOOD, HEAD, KEY, PEER, SIK, TOP, load, member, relay
from tests.config.fleets import (
    OTHER_SIGNER,
    OWN,
    authority,
    bulletin,
    certificate,
    contact,
    fleet,
    load_member,
    member_file,
)
from uavlinkd.authority.certificates import Certificate, MemberRole
from uavlinkd.config.changes import compare
from uavlinkd.config.members import relay_member
from uavlinkd.config.model import ConfigError, FleetConfig, PeerAddress
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.settings import Link
from uavlinkd.system.addresses import parse_address
from uavlinkd.system.base64_text import to_base64

_BOTH = c.FEATURE_RECORDS | c.FEATURE_FLEET
_VEHICLE, _OPERATOR = MemberRole.VEHICLE, MemberRole.OPERATOR
_OBSERVER, _RELAY = MemberRole.OBSERVER, MemberRole.RELAY
_GS, _R1 = contact(), contact(_RELAY, "r1")


def _fleet(folder: Path, text: str) -> FleetConfig:
    config = load_member(folder, text)
    assert config.fleet is not None
    return config.fleet


@pytest.mark.parametrize(("role", "called"), [(_VEHICLE, _OPERATOR), (_OPERATOR, _VEHICLE), (_OBSERVER, _VEHICLE)])
def test_either_end_calls_the_other(tmp_path: Path, role: MemberRole, called: MemberRole) -> None:
    """The one that starts later asks its relay, so neither waits for the other's next question."""
    assert _fleet(tmp_path, TOP + ENDPOINT + fleet(certificate(role))).call == {called}


def test_member_is_configured_by_its_line(tmp_path: Path) -> None:
    """No section names another member, except the contacts. A contact that relays serves all links."""
    config = load_member(tmp_path, member_file(fleet() + _GS + _R1, TOP))
    made = config.fleet
    assert made is not None
    assert made.authority.public == authority()
    assert made.own.data == b64decode(certificate())
    assert (set(made.call), made.required_bulletin, set(made.denied)) == ({_OPERATOR}, 0, set())
    assert made.state_file == tmp_path / "drone0.fleet-state"
    assert made.link.confidential
    assert made.link.features == Link().features | _BOTH
    assert [(contact.name, contact.role, contact.relays) for contact in made.contacts] == [
        ("gs", _OPERATOR, False),
        ("r1", _RELAY, True),
    ]
    (peer,) = config.peers
    assert (peer.name, peer.settings.is_certified, peer.relays) == ("gs", True, ("r1",))
    assert peer.addresses == (PeerAddress(parse_address("gs.example.org:5790", allow_names=True)),)
    assert peer.policy == {"role": "operator", "system_ids": (200,)}
    (used,) = config.relays
    assert (used.name, used.settings.is_certified, used.peer) == ("r1", True, None)
    assert used.settings.link.features == c.KNOWN_FEATURES
    assert config.warnings == ()


def test_state_is_kept_where_systemd_says(tmp_path: Path) -> None:
    """In the first folder of StateDirectory=."""
    config = load_member(tmp_path, member_file(fleet() + _GS), {"STATE_DIRECTORY": "/var/lib/a:/var/lib/b"})
    assert config.fleet is not None
    assert config.fleet.state_file == Path("/var/lib/a/drone0.fleet-state")


def test_station_that_relays_is_peer_and_relay_at_once(tmp_path: Path) -> None:
    """One session serves both. It is not reached along itself, but along another relay."""
    config = load_member(tmp_path, member_file(fleet() + contact(more="relays = true") + _R1, TOP))
    assert [(used.name, used.peer) for used in config.relays] == [("gs", "gs"), ("r1", None)]
    assert [peer.relays for peer in config.peers] == [("r1",)]


@pytest.mark.parametrize(
    ("own", "more", "policies"),
    [
        (_VEHICLE, "", {_VEHICLE: "swarm-member", _OPERATOR: "operator", _OBSERVER: "observer"}),
        (_VEHICLE, 'operator = "pinned"', {_VEHICLE: "swarm-member", _OBSERVER: "observer"}),
        (_OPERATOR, "", {_VEHICLE: "vehicle"}),
        (
            _OPERATOR,
            '[[fleet_role]]\nname = "operator"\nrole = "observer"',
            {_VEHICLE: "vehicle", _OPERATOR: "observer"},
        ),
        (_OBSERVER, "", {_VEHICLE: None}),
        (_RELAY, "", {}),
    ],
)
def test_role_of_a_member_is_its_policy(
    tmp_path: Path, own: MemberRole, more: str, policies: dict[MemberRole, str | None]
) -> None:
    """By the roles of both ends. A role without a policy has no link."""
    made = _fleet(tmp_path, member_file(fleet(certificate(own, "me"), more))).policies
    assert {role: policy.get("role") for role, policy in made.items()} == policies


def test_relay_needs_no_member_sections(tmp_path: Path) -> None:
    """Its limits for each member are in [relay_server]."""
    limits = "[relay_server]\nmember_bits_s = 70_000\n"
    config = load_member(tmp_path, HEAD + fleet(certificate(_RELAY, "r2")) + limits)
    assert config.relay_server is not None
    assert config.relay_server.members == ()
    assert config.fleet is not None
    made = relay_member(config.fleet, bytes(32), Certificate(bytes(4), 9, _VEHICLE, (1, 1), "v1"))
    assert (made.name, made.most_peers, made.bits_s) == ("v1", 256, 70_000)
    assert (made.peer.is_certified, made.peer.initiates, made.peer.link.features) == (True, False, _BOTH)


def test_pinned_links_carry_bulletins_in_a_fleet(tmp_path: Path) -> None:
    """Those of peers, relays and members of the file. Without [fleet], what they offer is as before."""
    sections = PEER + relay() + member("c")

    def offered(text: str) -> list[int]:
        config = load_member(tmp_path, text)
        assert config.relay_server is not None
        settings = [
            *(peer.settings for peer in config.peers),
            *(used.settings for used in config.relays),
            *(one.peer for one in config.relay_server.members),
        ]
        return [one.link.features for one in settings]

    before = offered(member_file(sections))
    usual = c.FEATURE_REFUSALS | c.FEATURE_PROBLEMS | c.FEATURE_RECORDS
    assert before == [usual, usual, c.FEATURE_RECORDS]
    assert offered(member_file(sections + fleet())) == [one | _BOTH for one in before]
    assert load(tmp_path, GOOD).peers[0].settings.link.features == Link().features
    assert not Link().features & _BOTH


_ANY = to_base64(bytes(100))
_FOREIGN = certificate(name="x", ids=(8, 8), signer=OTHER_SIGNER)
STATION = (
    f'[stations]\n[[station]]\nname = "tablet"\npublic_key = "{KEY["c"]}"\n'
    'address = "10.66.0.2"\nrole = "operator"\nsystem_ids = [250]\n'
)
_ROLE = '[[fleet_role]]\nname = "operator"\n'
_AUTHORITY = to_base64(authority())
_ROWS = [
    (
        fleet().replace(_AUTHORITY, to_base64(b"\xec" + b"\xff" * 30 + b"\x7f")),
        "fleet.authority",
        "is not the public key",
    ),
    (fleet().replace(_AUTHORITY, OWN[:-5]), "fleet.authority", "cut"),
    (
        fleet().replace(_AUTHORITY, "AAAA"),
        "fleet.authority",
        "not the public key of an authority, or was cut: run `uavlinkd enroll --finish` again",
    ),
    (fleet(_ANY), "fleet.certificate", "not a certificate"),
    (fleet(news=_ANY), "fleet.bulletin", "not a bulletin"),
    (fleet(news=bulletin(signer=OTHER_SIGNER)), "fleet.bulletin", "not signed by the authority"),
    (fleet(news=bulletin()[:-8] + "AAAAAA=="), "fleet.bulletin", "not signed by the authority"),
    (fleet(_FOREIGN), "fleet.certificate", "another authority: sign the line that `uavlinkd enroll` prints here"),
    (fleet(certificate(key=KEY["c"])), "fleet.certificate", "not for the key of private_key_file"),
    (
        fleet() + contact(signed=_FOREIGN),
        "contact[0].certificate (x)",
        "another authority: run `uavlinkd enroll --finish` again",
    ),
    (
        fleet() + contact(signed=certificate(name="gs", ids=(8, 8))),
        "contact[0].certificate (gs)",
        "not for the key of public_key",
    ),
    (fleet() + contact(address="[]"), "contact[0].addresses (gs)", "is empty: write its address"),
    (
        fleet() + SIK + contact(_RELAY, "r1", address='[{ network = "sik" }]'),
        "contact[0].addresses (r1)",
        "no address over IP",
    ),
    (fleet() + _GS + _GS, "contact[1].public_key (gs)", "is that of contact[0] (gs) too"),
    (
        fleet() + _GS + PEER.replace(KEY["drone1"], KEY["vps"]),
        "contact[0].public_key (gs)",
        "of peer[0] (drone1) too",
    ),
    (fleet() + contact(name="v7"), "contact[0] (v7)", "has the name of fleet"),
    (fleet(certificate(ids=(1, 255))) + _GS, "contact[0] (gs)", "has the system id 200 of fleet"),
    (fleet() + PEER.replace('"drone1"', '"v7"'), "fleet", "has the name of peer[0] (v7)"),
    (fleet() + PEER.replace("[2]", "[7]"), "fleet", "has the system id 7 of peer[0] (drone1)"),
    (fleet() + PEER.replace("[2]", "[200]") + _GS, "contact[0] (gs)", "the system id 200 of peer[0] (drone1)"),
    (
        fleet(certificate(MemberRole.OPERATOR, ids=(254, 255))) + STATION,
        "station[0].system_ids (tablet)",
        "whose certificate has 254 to 255",
    ),
    (_GS, "contact", "no effect without [fleet]"),
    (_ROLE, "fleet_role", "no effect without [fleet]"),
    (fleet() + _ROLE + _ROLE, "fleet_role[1].name (operator)", "is that of fleet_role[0] (operator) too"),
    (fleet() + _ROLE + "system_ids = [1]", "fleet_role[0].system_ids (operator)", "certificates name the ids"),
    (fleet(more='operator = "pinned"') + _ROLE, "fleet_role[0].name (operator)", 'with operator = "pinned"'),
    (fleet(certificate(_RELAY)) + _ROLE, "fleet_role[0].name (operator)", "a relay carries no frames"),
    (fleet(certificate(_OPERATOR)) + _ROLE, "fleet_role[0].role (operator)", "allow_out"),
    (fleet() + _ROLE + 'allow_in = ["no"]', "fleet_role[0].allow_in[0] (operator)", "no such group"),
    (fleet(more='call = ["relay"]'), "fleet.call[0]", '"vehicle", "operator" or "observer"'),
    (fleet(more='call = ["operator"]\noperator = "pinned"'), "fleet.call", "no link here"),
    (fleet(more='deny = ["V 3"]'), "fleet.deny[0]", "must be a name"),
    ("[fleet]\n", "fleet.certificate", "`uavlinkd enroll --finish` writes"),
    (relay("c") + relay("d") + fleet() + _R1 + contact(more="relays = true"), "relay", "has 4 sections, with each"),
]


@pytest.mark.parametrize(("sections", "key", "says"), _ROWS, ids=[f"{key}: {says}" for _, key, says in _ROWS])
def test_fleet_problem_is_named_with_what_to_write(tmp_path: Path, sections: str, key: str, says: str) -> None:
    """No other problem follows from it."""
    with pytest.raises(ConfigError) as caught:
        load_member(tmp_path, member_file(sections))
    problems = {problem.key: problem.message for problem in caught.value.problems}
    assert says in problems.get(key, f"not among {problems}")
    assert all(other == key or "is missing" in message for other, message in problems.items()), problems


def test_four_contacts_are_too_many(tmp_path: Path) -> None:
    """The line of an authority has three at most."""
    with pytest.raises(ConfigError, match="contact: has 4 sections"):
        load_member(tmp_path, member_file(fleet() + _GS * 4))


def test_readable_links_of_members_are_warned_of(tmp_path: Path) -> None:
    """As those of peers, also without a contact that is a peer."""
    (warning,) = load_member(tmp_path, TOP + ENDPOINT + fleet() + _R1).warnings
    assert warning.startswith("members by certificate: a link through a relay is not confidential")


@pytest.mark.parametrize(
    ("after", "changes"),
    [
        (fleet(more="require_bulletin = 2"), {"fleet_changed": ["required_bulletin"]}),
        (fleet(more='call = []\ndeny = ["v3"]'), {"fleet_changed": ["call", "denied"]}),
        (fleet(more='operator = "pinned"'), {"fleet_changed": ["call", "policies"]}),
        (fleet(more=_ROLE + "rate_in = { PING = 0 }"), {"fleet_changed": ["policies"]}),
        (fleet(news=bulletin(2)), {"fleet_changed": ["bulletin"]}),
    ],
)
def test_reload_changes_what_a_fleet_may_do(tmp_path: Path, after: str, changes: dict[str, list[str]]) -> None:
    """Each change names the fields that differ."""
    before = load_member(tmp_path, member_file(fleet()))
    assert compare(before, load_member(tmp_path, member_file(fleet()))).summary == {}
    assert compare(before, load_member(tmp_path, member_file(after))).summary == changes


def test_another_fleet_needs_a_restart(tmp_path: Path) -> None:
    """Another authority, or one where there was none; and another relay."""
    config = load_member(tmp_path, member_file(fleet()))
    with pytest.raises(ConfigError, match=r"relay: has changed.*restart the daemon"):
        compare(config, load_member(tmp_path, member_file(fleet() + _R1)))
    with pytest.raises(ConfigError, match=r"fleet\.authority: has changed.*restart the daemon"):
        compare(replace(config, fleet=None), config)
