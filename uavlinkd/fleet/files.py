"""What stands in a member's folder: its configuration, as text for a person, and the names of its key files."""

from __future__ import annotations

from uavlinkd.system.addresses import Address
from uavlinkd.fleet.manifest import ROLES, Fleet, Kind, Member, literal
from uavlinkd.fleet.plan import listen_address

_ENDPOINT_NAMES = {
    Kind.DRONE: "autopilot",
    Kind.GROUND_STATION: "ground-control",
    Kind.OBSERVER: "ground-control",
}


def config_file(member: Member) -> str:
    """Of the configuration, in the member's folder."""
    return f"{member.name}.toml"


def key_file(member: Member) -> str:
    """Of the private key."""
    return f"{member.name}.key"


def previous_key_file(member: Member) -> str:
    """Of the private key before, while it is being changed."""
    return f"{member.name}.previous.key"


def psk_file(other: Member) -> str:
    """Of the key shared with another member."""
    return f"{other.name}.psk"


def write_config(fleet: Fleet, member: Member) -> str:
    """A complete configuration."""
    settings = fleet.settings
    listen = [] if member.address is None else [str(listen_address(member.address))]
    lines = [
        f"# {member.name}, {_DESCRIPTIONS[member.kind]} of MAVLink system id {member.system_id}.",
        "# Written by `uavlinkd fleet`; what you change here stays, other members' keys are kept up to date.",
        "",
        f"name = {literal(member.name)}",
        *key_lines(member),
        f"listen = {literal(listen)}",
        f"control_socket = {literal(settings.control_socket_of(member))}",
        "",
        "[link]",
        f"suites = {literal([settings.suite])}",
        "",
        "[[endpoint]]",
        f"name = {literal(_ENDPOINT_NAMES[member.kind])}",
        f"url = {literal(settings.url_of(member))}",
        f"system_ids = [{member.system_id}]",
    ]
    if member.kind is Kind.OBSERVER:
        lines.append('role = "observer"')
    sections = ["\n".join(lines) + "\n", *(peer_section(fleet, member, peer) for peer in fleet.peers_of(member))]
    return "\n".join(sections)


_DESCRIPTIONS = {
    Kind.DRONE: "a drone",
    Kind.GROUND_STATION: "a ground station",
    Kind.OBSERVER: "an observer",
}


def key_lines(member: Member) -> list[str]:
    """Which private keys it has."""
    lines = [f"private_key_file = {literal(key_file(member))}"]
    if member.previous_public_key is not None:
        lines.append(f"previous_private_key_file = {literal(previous_key_file(member))}")
    return lines


def peer_section(fleet: Fleet, member: Member, peer: Member) -> str:
    """What a member's configuration says about another."""
    addresses: list[Address] = [] if peer.address is None else [peer.address]
    lines = ["[[peer]]", f"name = {literal(peer.name)}", *public_key_lines(peer)]
    if addresses:
        lines.append(f"addresses = {literal([str(each) for each in addresses])}")
    if fleet.settings.psk:
        lines.append(f"psk_file = {literal(psk_file(peer))}")
    lines += [f"role = {literal(ROLES[member.kind, peer.kind])}", f"system_ids = [{peer.system_id}]"]
    return "\n".join(lines) + "\n"


def public_key_lines(peer: Member) -> list[str]:
    """By which keys it is known."""
    lines = [f"public_key = {literal(peer.public_key)}"]
    if peer.previous_public_key is not None:
        lines.append(f"previous_public_key = {literal(peer.previous_public_key)}")
    return lines
