"""What a member asks its relays for when it tests filters, and which tokens it takes: with literal times."""

from __future__ import annotations

from itertools import count

import pytest

from tests.core.harness import AT_B, ELSEWHERE, KEY_B, KEY_C
from tests.link.test_relay_link import LINK, RelayMember, T
from uavlinkd.core import constants as c
from uavlinkd.core import outputs as o
from uavlinkd.core.drops import DropReason
from uavlinkd.core.path import Path
from uavlinkd.core.relay_records import Bind, FilterTest, FilterTested, token_datagram
from uavlinkd.core.settings import PeerSettings
from uavlinkd.link.relays import FilterTests

OTHER_PORT = Path(AT_B.socket, (AT_B.host, 50_000))


class Scene(RelayMember):
    """A member that tests filters."""

    def __init__(self) -> None:
        super().__init__()
        numbers = count()  # each token is another one
        self.tests = FilterTests(self.pair.a.node, lambda size: bytes([next(numbers)]) * size)

    def asked(self, now: float) -> list[bytes]:
        """The tokens that the relay is asked for now."""
        records = self.received(self.tests.do_due(now), now)
        return [record.token for record in records if isinstance(record, FilterTest)]

    def answer(self, token: bytes, path: Path = AT_B) -> None:
        """The relay says that it sent a token."""
        self.tests.on_record(o.RecordReceived(self.link.peer, path, FilterTested(token), 1))

    def ask_all(self, *, answers: int) -> bytes:
        """Ask in vain, with answers to the first tries. The token."""
        asked = [self.asked(self.tests.next_at) for _ in range(c.FILTER_TRIES)]
        ((token,),) = {tuple(one) for one in asked}
        for _ in range(answers):
            self.answer(token)
        return token

    @property
    def passes(self) -> list[bool | None]:
        """The results."""
        return [result.passes for result in self.tests.results]


@pytest.fixture
def scene() -> Scene:
    """A member with a session, which begins its tests."""
    scene = Scene()
    scene.tests.begin([scene.link], T)
    return scene


@pytest.mark.parametrize(("answers", "passes"), [(0, None), (1, None), (2, False), (3, False)])
def test_answers_without_a_token_show_a_filter(answers: int, passes: bool | None, scene: Scene) -> None:
    """Unless there is one answer only: the token may have been lost."""
    scene.ask_all(answers=answers)
    scene.asked(T + 9)
    assert scene.passes == [passes]


def test_token_and_its_answer_end_the_test(scene: Scene) -> None:
    """Whichever comes first. A second copy of the token is not dropped; a later one is."""
    (token,) = scene.asked(T)
    assert scene.tests.take_token(token_datagram(token), OTHER_PORT)
    assert scene.tests.take_token(token_datagram(token), OTHER_PORT)
    assert scene.tests.next_at == T + c.FILTER_TRY_S
    scene.answer(token)
    assert scene.tests.next_at < T
    assert not scene.asked(T + 0.01)
    assert scene.tests.ended.is_set()
    assert scene.passes == [True]
    assert not scene.tests.take_token(token_datagram(token), OTHER_PORT)


def test_token_after_its_answers_ends_the_test(scene: Scene) -> None:
    """The network reordered them, or the first token was lost."""
    (token,) = scene.asked(T)
    scene.answer(token)
    scene.asked(scene.tests.next_at)
    scene.answer(token)
    assert scene.tests.next_at > T
    assert scene.tests.take_token(token_datagram(token), OTHER_PORT)
    assert scene.tests.next_at < T
    assert not scene.asked(T + 0.5)
    assert scene.passes == [True]


@pytest.mark.parametrize(
    ("path", "change"),
    [
        (AT_B, b""),
        (ELSEWHERE, b""),
        (Path(AT_B.socket + 1, OTHER_PORT.address), b""),
        (OTHER_PORT, b"\0"),
    ],
    ids=["the relay's own port", "another host", "another socket", "another length"],
)
def test_other_datagrams_with_the_token_show_nothing(path: Path, change: bytes, scene: Scene) -> None:
    """They are dropped, and the result is as without them."""
    token = scene.ask_all(answers=3)
    assert not scene.tests.take_token(token_datagram(token) + change, path)
    assert not scene.tests.take_token(token_datagram(bytes(c.FILTER_TOKEN_BYTES)[1:] + b"\7"), OTHER_PORT)
    scene.asked(T + 9)
    assert scene.passes == [False]


def test_token_from_a_port_of_another_peer_shows_nothing(scene: Scene) -> None:
    """It shares the relay's host. This daemon sends there, so a NAT lets it in."""
    other = scene.pair.a.node.add_peer(PeerSettings("other", KEY_C.public, None, LINK), T)
    scene.pair.a.node.set_paths(other, [OTHER_PORT], T)
    token = scene.ask_all(answers=3)
    assert not scene.tests.take_token(token_datagram(token), OTHER_PORT)
    scene.asked(T + 9)
    assert scene.passes == [False]


def test_answers_of_others_do_not_count(scene: Scene) -> None:
    """Along another path, for another token, of another peer, and other records."""
    token = scene.ask_all(answers=1)
    scene.answer(token, ELSEWHERE)
    scene.answer(bytes([9]) * c.FILTER_TOKEN_BYTES)
    for peer, record in ((scene.pair.b.peer, FilterTested(token)), (scene.link.peer, Bind((KEY_B.public,)))):
        received = o.RecordReceived(peer, AT_B, record, 1)
        assert scene.tests.on_record(received) is DropReason.UNEXPECTED_RECORD
    scene.asked(T + 9)
    assert scene.passes == [None]


def test_tests_that_run_are_not_begun_again(scene: Scene) -> None:
    """Two people ask at the same time: both get the same results. Later tests have other tokens."""
    scene.tests.begin([scene.link], T)
    token = scene.ask_all(answers=2)
    scene.tests.begin([scene.link], T + 1)
    scene.asked(T + 9)
    assert scene.passes == [False]
    scene.tests.begin([scene.link], T + 10)
    assert scene.passes == []
    (other,) = scene.asked(T + 10)
    assert other != token


def test_best_path_from_each_socket_is_tested() -> None:
    """Others of the same socket lead through the same NAT; serial and relayed ones through none."""
    scene = Scene()
    second, third = Path(0, ("192.0.2.8", 5790)), Path(1, AT_B.address)
    scene.link.set_paths([AT_B, second, third], 0.0)
    for path, srtt_s in ((AT_B, 0.2), (second, 0.1), (third, None)):
        state = scene.link.peer.paths.find(path)
        assert state is not None
        state.srtt_s = srtt_s
        state.set_usable(T)
    scene.tests.begin([scene.link], T)
    assert {(test.path, test.try_s) for test in scene.tests._tests.values()} == {(second, 0.3), (third, 0.3)}
