"""Which pairs of keys may be right while keys change, and what a configuration may say of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import structlog

from tests.policies import TRUSTED
from uavlinkd.config import Config, ConfigError, keys
from uavlinkd.config import PeerConfig as Peer
from uavlinkd.config.changes import compare
from uavlinkd.config.load import load_config
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.settings import PeerSettings, link_name
from uavlinkd.link import peers as module
from uavlinkd.link.carrier import FrameCarrier
from uavlinkd.link.parts import DaemonParts
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.peers import pairings

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


@pytest.mark.parametrize(
    ("own", "theirs", "key"),
    [
        ('previous_private_key_file = "a.key"', "", "previous_private_key_file"),
        ('previous_private_key_file = "none.key"', "", "previous_private_key_file"),
        ("", was(THEIRS), "peer[0].previous_public_key (b)"),
        ("", was(OWN), "peer[0].previous_public_key (b)"),
        (OUR_LINE, was(PREVIOUS), "peer[0].previous_public_key (b)"),
        ("", 'previous_public_key = "none"', "peer[0].previous_public_key (b)"),
    ],
    ids=["own key", "missing file", "a peer's key", "our key", "our previous key", "malformed"],
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


class Scene:
    """The peers of a daemon that knows one peer by two keys, and has two itself. The time is what a test says."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.psks = 0.0, 0
        monkeypatch.setattr(module, "monotonic", lambda: self.now)
        monkeypatch.setattr(module, "KEY_GRACE_S", 10.0)
        config = load(folder, OUR_LINE, was(THEIRS_BEFORE))
        self.config = replace(config, peers=config.peers[:1])
        self.parts = DaemonParts(self.config, structlog.get_logger(), 0.0, lambda _: None)
        self.peers = FrameCarrier(self.parts).peers
        self.peers.start()

    @property
    def names(self) -> list[str]:
        """What the core has."""
        return list(self.parts.node.peers)

    @property
    def link(self) -> PeerLink:
        """To the peer."""
        return self.parts.links["b"]

    def reload(self, peer: Peer, now: float) -> None:
        """Another configuration of the peer."""
        self.now = now
        config = replace(self.parts.config, peers=(peer,))
        self.peers.follow(config, compare(self.parts.config, config))

    def create_again(self, now: float) -> None:
        """A reload that creates the link again."""
        (peer,) = self.parts.config.peers
        self.psks += 1
        psk = Secret(bytes([self.psks]) * 32)
        self.reload(replace(peer, settings=replace(peer.settings, psk=psk)), now)


@pytest.fixture
async def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scene:
    """In a running loop."""
    return Scene(tmp_path, monkeypatch)


async def test_the_end_of_their_change_leaves_ours(scene: Scene) -> None:
    """Their previous key is out of the file: the peer is still accepted where it knows us by our previous one."""
    assert scene.names == ["b", "b (previous key)", "b (our previous key)", "b (previous key) (our previous key)"]
    scene.reload(replace(scene.config.peers[0], previous_public_key=None), 1.0)
    assert scene.names == ["b", "b (our previous key)"]
    assert scene.link.previous
    config = replace(scene.parts.config, previous_private_key=None)
    scene.peers.follow(config, compare(scene.parts.config, config))
    assert scene.names == ["b"]


async def test_link_that_is_created_again_gets_no_second_grace(scene: Scene) -> None:
    """A reload that creates a link again revives neither an ended key nor its time; only the operator does."""
    scene.create_again(6.0)
    assert len(scene.names) == 4
    scene.peers.end_graces(9.9)
    assert len(scene.names) == 4
    scene.peers.end_graces(10.0)
    assert scene.names == ["b"]
    scene.create_again(11.0)
    assert not scene.link.previous

    (peer,) = scene.parts.config.peers
    scene.reload(replace(peer, previous_public_key=None), 12.0)
    scene.reload(peer, 12.0)
    assert scene.names == ["b", "b (previous key)"]  # theirs is valid again, not ours
    scene.peers.confirm_keys(scene.link)
    scene.create_again(14.0)
    assert not scene.link.previous


async def test_our_previous_key_stays_given_up_when_their_key_changes(scene: Scene) -> None:
    """A peer that knows our new key does not bring the one before back by a new key of its own."""
    (peer,) = scene.config.peers
    scene.reload(replace(peer, previous_public_key=None), 0.0)
    scene.peers.confirm_keys(scene.link)
    assert scene.names == ["b"]
    newest = KeyPair(keys.decode_key(OTHER)).public
    rotated = replace(
        peer,
        settings=replace(peer.settings, public_key=newest),
        previous_public_key=peer.settings.public_key,
    )
    scene.reload(rotated, 2.0)
    assert scene.names == ["b", "b (previous key)"]
