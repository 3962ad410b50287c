"""The files in a member's folder: the text of its configuration, and the names of its key files."""

from __future__ import annotations

from uavlinkd.fleet.manifest import ROLES, Fleet, Member, MemberKind, fill, literal

CONFIDENTIAL = "confidential = true"
"""In ``[link]`` of a fleet with relays: otherwise their owners could read the frames."""


def config_file(member: Member) -> str:
    """The name of a member's configuration file."""
    return f"{member.name}.toml"


def key_file(member: Member) -> str:
    """The name of its private key file."""
    return f"{member.name}.key"


def previous_key_file(member: Member) -> str:
    """The name of the file with its previous private key, during a rotation."""
    return f"{member.name}.previous.key"


def psk_file(other: Member) -> str:
    """The name of the file with the PSK that it shares with another member."""
    return f"{other.name}.psk"


def write_config(fleet: Fleet, member: Member) -> str:
    """The text of a member's configuration."""
    settings, kind = fleet.settings, member.kind.value.replace("-", " ")
    url = settings.drone_url if member.is_drone else settings.ground_station_url
    numbered = "" if member.is_relay else f" with MAVLink system id {member.system_id}"
    lines = [
        f"# {member.name}, {'an' if kind == 'observer' else 'a'} {kind}{numbered}.",
        "# Written by `uavlinkd fleet`. Later commands change keys and peers, and keep your other edits.",
        "",
        f"name = {literal(member.name)}",
        *key_lines(member),
        f"listen = {literal(_listen(member))}",
        f"control_socket = {literal(fill(settings.control_socket, member.system_id, member.name))}",
        "",
        "[link]",
        f"suites = {literal([settings.suite])}",
    ]
    if not member.is_relay:
        if fleet.relays:
            lines.append(CONFIDENTIAL)
        lines += [
            "",
            "[[endpoint]]",
            f"name = {literal('autopilot' if member.is_drone else 'ground-control')}",
            f"url = {literal(fill(url, member.system_id, member.name))}",
            f"system_ids = [{member.system_id}]",
        ]
    if member.kind is MemberKind.OBSERVER:
        lines.append('role = "observer"')
    sections = ["\n".join(lines) + "\n", *(peer_section(fleet, member, peer) for peer in fleet.peers_of(member))]
    return "\n".join(sections)


def _listen(member: Member) -> list[str]:
    if (address := member.address) is None:
        return []
    if address.ip is not None and address.is_loopback:
        return [str(address)]
    both = [f"0.0.0.0:{address.port}", f"[::]:{address.port}"]
    if member.is_relay:  # members may have either family
        return both
    return both[1:] if address.ip is not None and address.ip.version == 6 else both[:1]


def key_lines(member: Member) -> list[str]:
    """The lines that name a member's private key files."""
    lines = [f"private_key_file = {literal(key_file(member))}"]
    if member.previous_public_key is not None:
        lines.append(f"previous_private_key_file = {literal(previous_key_file(member))}")
    return lines


def peer_section(fleet: Fleet, member: Member, peer: Member) -> str:
    """The section about another member: ``[[peer]]``, ``[[relay]]`` or ``[[member]]``."""
    kind = member.section_of(peer)
    lines = [f"[[{kind}]]", f"name = {literal(peer.name)}", *public_key_lines(peer)]
    if peer.address is not None and kind != "member":
        lines.append(f"addresses = {literal([str(peer.address)])}")
    if fleet.settings.psk:
        lines.append(f"psk_file = {literal(psk_file(peer))}")
    if kind == "peer":
        lines += [f"role = {literal(ROLES[member.kind, peer.kind])}", f"system_ids = [{peer.system_id}]"]
    return "\n".join(lines) + "\n"


def public_key_lines(peer: Member) -> list[str]:
    """The lines with a peer's public keys."""
    lines = [f"public_key = {literal(peer.public_key)}"]
    if peer.previous_public_key is not None:
        lines.append(f"previous_public_key = {literal(peer.previous_public_key)}")
    return lines
