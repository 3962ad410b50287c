"""What tests of other rooms see and set inside the core: only this folder names its private attributes."""

from __future__ import annotations

from collections.abc import Callable

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.admission import Admission
from uavlinkd.protocol.cookie import MacKeys
from uavlinkd.protocol.kem import KemPrivateKey
from uavlinkd.protocol.limits import SourceLimiter, TokenBucket
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.noise import HandshakeState
from uavlinkd.protocol.path_state import PathCondition, PathState
from uavlinkd.protocol.paths import PathSet
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.reports import Claim, Claims
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.wire import RefusalReport


def set_entropy(node: Node, entropy: Callable[[int], bytes]) -> None:
    """Give a node and its peers another random source."""
    node._entropy = node._handshakes.cookies._entropy = node._indices._entropy = entropy
    for peer in node.peers.values():
        peer.entropy = peer.initiator._entropy = entropy


def refill(node: Node, now: float) -> None:
    """Give a node all budgets of handshakes again, and let it forget who asked."""
    node._handshakes.admission = Admission(node._is_known, now)


def give_small_budgets(node: Node, budget: float, now: float) -> None:
    """Give a node ``budget`` handshakes before it asks for cookies, and the usual count of initiations to read."""
    admission = node._handshakes.admission
    admission._initiations, admission._responses = TokenBucket(1.0, budget, now), TokenBucket(1.0, budget, now)
    admission._read = TokenBucket(*c.INITIATIONS_READ, now)
    admission._known_read = SourceLimiter(*c.INITIATIONS_READ_PER_KNOWN)


def take_any_key(node: Node) -> None:
    """Remove the check of the static key: every initiator is the node's first peer."""

    class AnyKey(dict[bytes, Peer]):
        """Ignores the key, and answers with the initiator's."""

        def get(self, key: bytes, _default: object = None) -> Peer:
            peer = next(iter(self.values()))
            peer.initiator._mac_keys = MacKeys(key)
            return peer

    node._handshakes.peers = AnyKey(node._handshakes.peers)


def forget_secret(key: KemPrivateKey) -> None:
    """Let an ephemeral KEM key compute its shared secret again."""
    key._computed = None


def owned_indices(node: Node) -> int:
    """The number of indices in use."""
    return len(node._indices.owners)


def remembered_initiations(node: Node) -> int:
    """The number of initiations that a node remembers, of all peers."""
    return len(node._handshakes.remembered)


def asked_candidates(paths: PathSet) -> int:
    """The number of candidates whose questions wait for an answer."""
    return len(paths._asked)


def counted_refusals(peer: Peer) -> int:
    """The number of own refusals that are counted for a peer."""
    return len(peer.reports.refusals)


def held_frames(session: Session) -> int:
    """The number of payloads that wait until freshness is verified."""
    return len(session.held._frames)


def history_steps(session: Session) -> int:
    """The number of steps in the history of what was received."""
    return len(session._received_history._steps)


def believe(claims: Claims, report: RefusalReport, now: float) -> None:
    """Keep every claim of a report, whatever their number."""
    claims._refusals.update({refused[:3]: Claim(refused, now) for refused in report.entries})


def mix(state: HandshakeState, token: str) -> HandshakeState:
    """Mix the secret of a token of the pattern into a handshake."""
    return state._mix(token)


def set_condition(state: PathState, condition: PathCondition, now: float) -> None:
    """Put a path in a condition, as if it did not answer."""
    state._set(condition, "unanswered", now)


def set_routes(paths: PathSet, now: float) -> None:
    """Choose the paths of each class again."""
    paths._set_routes(now)
