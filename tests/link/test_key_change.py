"""Which pairs of keys may be right while keys change, and what a configuration may say of them."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from tests.policies import TRUSTED
from uavlinkd.config import Config, ConfigError, keys
from uavlinkd.config import PeerConfig as Peer
from uavlinkd.config.changes import compare
from uavlinkd.config.load import load_config
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.node import Node
from uavlinkd.core.settings import PeerSettings
from uavlinkd.link.key_change import Graces, link_name, pairings
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.ops.topology import print_topology

OWN, PREVIOUS, THEIRS, THEIRS_BEFORE, OTHER = (keys.generate_private_key() for _ in range(5))

OPEN = 'role = "all"\nsystem_ids = "all"\n'


def load(folder: Path, own: str = "", theirs: str = "") -> Config:
    """A configuration with these lines at the top, and in its one peer."""
    for name, key in (("a.key", OWN), ("a.previous.key", PREVIOUS)):
        if not (folder / name).exists():
            keys.write_secret_file(folder / name, key)
    path = folder / "a.toml"
    path.write_text(
        f'name = "a"\nprivate_key_file = "a.key"\nlisten = ["0.0.0.0:5790"]\n{own}\n'
        f'[[peer]]\nname = "b"\npublic_key = "{keys.public_key_text(THEIRS)}"\n{OPEN}{theirs}\n'
        f'[[peer]]\nname = "c"\npublic_key = "{keys.public_key_text(OTHER)}"\n{OPEN}'
    )
    return load_config(path, {})


def was(private: str) -> str:
    """The line that names a previous public key."""
    return f'previous_public_key = "{keys.public_key_text(private)}"'


OUR_LINE = 'previous_private_key_file = "a.previous.key"'


def test_every_pair_of_keys_that_may_be_right_is_tried() -> None:
    """Two keys of ours and two of theirs make four, the current ones first; each has a name that leads back."""
    now, before = bytes([1]) * 32, bytes([2]) * 32
    peer = Peer(PeerSettings("b", now), (), TRUSTED, previous_public_key=before)
    pairs = pairings(peer, has_previous_key=True)

    assert [(pair.settings.public_key, pair.by_our_previous) for pair in pairs] == [
        (now, False),
        (before, False),
        (now, True),
        (before, True),
    ]
    names = [pair.settings.name for pair in pairs]
    assert names[0] == "b"
    assert len(set(names)) == 4
    assert {link_name(name) for name in names} == {"b"}
    assert [pair.by_our_previous for pair in pairs] == [False, False, True, True]
    assert [pair.by_their_previous for pair in pairs] == [False, True, False, True]
    assert len(pairings(Peer(PeerSettings("b", now), (), TRUSTED), has_previous_key=False)) == 1


def test_the_end_of_their_change_leaves_ours() -> None:
    """Their previous key is out of the file: the peer is still accepted where it knows us by our previous one."""
    now, before = (KeyPair(keys.decode_key(text)).public for text in (THEIRS, THEIRS_BEFORE))
    node = Node(Secret(keys.decode_key(OWN)), bytes, 0.0, Secret(keys.decode_key(PREVIOUS)))
    config = Peer(PeerSettings("b", now), (), TRUSTED, previous_public_key=before)
    link = PeerLink(config, node, lambda _: None, 0.0)
    link.join(0.0, Graces(), 10.0, has_previous_key=True)
    assert len(node.peers) == 4
    link.change(replace(config, previous_public_key=None), 1.0)
    assert list(node.peers) == ["b", "b (our previous key)"]
    assert link.accepts_previous_keys
    link.give_up_ours(2.0)
    assert list(node.peers) == ["b"]


def test_previous_keys_are_loaded(tmp_path: Path) -> None:
    """Both kinds of previous keys, and how long they are good, come from the file."""
    config = load(tmp_path, f"{OUR_LINE}\nkey_grace_s = 60", was(THEIRS_BEFORE))
    assert config.previous_private_key is not None
    assert config.previous_private_key.reveal() == keys.decode_key(PREVIOUS)
    assert config.key_grace_s == 60
    before = keys.decode_key(keys.public_key_text(THEIRS_BEFORE))
    assert [peer.previous_public_key for peer in config.peers] == [before, None]


def test_previous_keys_are_shown(tmp_path: Path) -> None:
    """`uavlinkd check` prints the previous keys that are valid, and for how long."""
    text = printed(load(tmp_path, f"{OUR_LINE}\nkey_grace_s = 60", was(THEIRS_BEFORE)))
    assert f"previous key  {keys.public_key_text(PREVIOUS)}" in text
    assert "valid until the peer confirms the new key, at most 60 s" in text
    assert f"or {keys.short_form(keys.decode_key(keys.public_key_text(THEIRS_BEFORE)))}" in text
    assert "at most 7 days" in printed(load(tmp_path, OUR_LINE))
    assert "before" not in printed(load(tmp_path))


def printed(config: Config) -> str:
    """What `uavlinkd check` prints of it."""
    file = io.StringIO()
    print_topology(config, Console(file=file, width=200, force_terminal=False))
    return file.getvalue()


def test_peers_have_no_previous_keys_by_default(tmp_path: Path) -> None:
    """A file that names none accepts none."""
    config = load(tmp_path)
    assert config.previous_private_key is None
    assert [peer.previous_public_key for peer in config.peers] == [None, None]


@pytest.mark.parametrize(
    ("own", "theirs", "key"),
    [
        ('previous_private_key_file = "a.key"', "", "previous_private_key_file"),
        ('previous_private_key_file = "none.key"', "", "previous_private_key_file"),
        ("key_grace_s = 0", "", "key_grace_s"),
        ("", was(THEIRS), "peer[0].previous_public_key (b)"),
        ("", was(OWN), "peer[0].previous_public_key (b)"),
        (OUR_LINE, was(PREVIOUS), "peer[0].previous_public_key (b)"),
        ("", 'previous_public_key = "none"', "peer[0].previous_public_key (b)"),
    ],
    ids=["own key", "missing file", "no grace", "a peer's key", "our key", "our previous key", "malformed"],
)
def test_impossible_previous_keys_are_refused(tmp_path: Path, own: str, theirs: str, key: str) -> None:
    """A previous key differs from every current key."""
    with pytest.raises(ConfigError) as error:
        load(tmp_path, own, theirs)
    assert [problem.key for problem in error.value.problems] == [key]


def test_previous_keys_of_two_peers_differ(tmp_path: Path) -> None:
    """Nor may it be what another peer has, or had; or ours be what a peer has."""
    mine, first, second = (keys.generate_private_key() for _ in range(3))
    keys.write_secret_file(tmp_path / "a.key", mine)
    keys.write_secret_file(tmp_path / "a.previous.key", PREVIOUS)
    path = tmp_path / "a.toml"
    top = f'name = "a"\nprivate_key_file = "a.key"\nlisten = ["0.0.0.0:5790"]\n{OUR_LINE}\n'

    def peer(name: str, private: str, before: str) -> str:
        return f'[[peer]]\nname = "{name}"\npublic_key = "{keys.public_key_text(private)}"\n{OPEN}{before}\n'

    for b, c, place in (
        (peer("b", first, was(second)), peer("c", second, ""), "peer[0].previous_public_key (b)"),
        (peer("b", first, was(OWN)), peer("c", second, was(OWN)), "peer[1].previous_public_key (c)"),
        (peer("b", PREVIOUS, ""), peer("c", second, ""), "peer[0].public_key (b)"),
    ):
        path.write_text(top + b + c)
        with pytest.raises(ConfigError) as error:
            load_config(path, {})
        assert [problem.key for problem in error.value.problems] == [place]


def test_a_peers_previous_key_comes_with_a_new_link(tmp_path: Path) -> None:
    """A link accepts the keys that it was created with: one more previous key replaces it, one less does not."""
    without, having = load(tmp_path), load(tmp_path, theirs=was(THEIRS_BEFORE))
    coming, going = compare(without, having), compare(having, without)
    assert coming.removed_peers == ("b",)
    assert [peer.name for peer in coming.added_peers] == ["b"]
    assert (going.removed_peers, going.added_peers) == ((), ())
    assert [peer.name for peer in going.changed_peers] == ["b"]


def test_grace_is_fixed(tmp_path: Path) -> None:
    """It began with the links."""
    with pytest.raises(ConfigError, match="key_grace_s"):
        compare(load(tmp_path, OUR_LINE), load(tmp_path, f"{OUR_LINE}\nkey_grace_s = 60"))


def test_previous_key_may_go_while_the_daemon_runs_and_not_come(tmp_path: Path) -> None:
    """Its end is a reload; its beginning comes with a new key, and so with a restart."""
    without, having = load(tmp_path), load(tmp_path, OUR_LINE)
    compare(having, without)
    with pytest.raises(ConfigError, match="previous_private_key_file"):
        compare(without, having)


def test_link_that_is_created_again_gets_no_second_grace() -> None:
    """A reload that creates a link again revives neither an ended key nor its time; only the operator does."""
    now, before = (KeyPair(keys.decode_key(text)).public for text in (THEIRS, THEIRS_BEFORE))
    node = Node(Secret(keys.decode_key(OWN)), bytes, 0.0, Secret(keys.decode_key(PREVIOUS)))
    config = Peer(PeerSettings("b", now), (), TRUSTED, previous_public_key=before)
    graces = Graces()

    def joined(at: float) -> PeerLink:
        if "b" in node.peers:
            for name in list(node.peers):
                node.remove_peer(node.peers[name], at)
        link = PeerLink(config, node, lambda _: None, at)
        link.join(at, graces, 10.0, has_previous_key=True)
        return link

    joined(0.0)
    link = joined(6.0)
    assert len(node.peers) == 4
    assert not link.end_graces(9.9, graces)
    assert link.end_graces(10.0, graces)
    assert list(node.peers) == ["b"]
    assert not joined(11.0).accepts_previous_keys

    without = replace(config, previous_public_key=None)
    graces.follow([config], [without])
    graces.follow([without], [config])
    link = joined(12.0)
    assert list(node.peers) == ["b", "b (previous key)"]  # theirs is valid again, not ours
    assert link.confirm(13.0, graces)
    assert not joined(14.0).accepts_previous_keys


def test_our_previous_key_stays_given_up_when_their_key_changes() -> None:
    """A peer that knows our new key does not bring the one before back by a new key of its own."""
    first, second = (KeyPair(keys.decode_key(text)).public for text in (THEIRS_BEFORE, THEIRS))
    graces = Graces()
    node = Node(Secret(keys.decode_key(OWN)), bytes, 0.0, Secret(keys.decode_key(PREVIOUS)))
    link = PeerLink(Peer(PeerSettings("b", first), (), TRUSTED), node, lambda _: None, 0.0)
    link.join(0.0, graces, 10.0, has_previous_key=True)
    assert list(node.peers) == ["b", "b (our previous key)"]
    assert link.confirm(1.0, graces)
    link.leave(2.0)
    rotated = PeerLink(
        Peer(PeerSettings("b", second), (), TRUSTED, previous_public_key=first), node, lambda _: None, 2.0
    )
    rotated.join(2.0, graces, 10.0, has_previous_key=True)
    assert list(node.peers) == ["b", "b (previous key)"]
