"""Handles on paths to relays: only those that were assigned lead somewhere, in both directions."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from uavlinkd.core.drops import DropReason
from uavlinkd.core.path import Path, relayed
from uavlinkd.core.relay_records import wrap
from uavlinkd.link.relay_handles import RelayHandles

LTE, MESH = Path(0, ("203.0.113.1", 5790)), Path(1, ("203.0.113.1", 5790))
ENVELOPE = b"\x40envelope"


def test_what_is_wrapped_here_is_unwrapped_there() -> None:
    """Data goes to the address of the relay; what comes from there came along the relayed path."""
    paths = RelayHandles()
    paths.assign("vps", LTE, [7, 8])
    assert paths.wrap(ENVELOPE, relayed(0, "vps", 7)) == (wrap(7, ENVELOPE), LTE.address)
    assert paths.unwrap(0, wrap(7, ENVELOPE), LTE.address) == (ENVELOPE, relayed(0, "vps", 7))


def test_handle_is_valid_on_its_socket_and_from_its_relay_only() -> None:
    """The same relay along another network has other handles."""
    paths = RelayHandles()
    paths.assign("vps", LTE, [7])
    paths.assign("vps", MESH, [9])
    unknown = DropReason.RELAY_UNKNOWN_HANDLE
    assert paths.unwrap(1, wrap(7, ENVELOPE), MESH.address) is unknown
    assert paths.unwrap(0, wrap(9, ENVELOPE), LTE.address) is unknown
    assert paths.unwrap(0, wrap(7, ENVELOPE), ("203.0.113.1", 5791)) is unknown
    assert paths.wrap(ENVELOPE, relayed(1, "vps", 7)) is None
    assert paths.wrap(ENVELOPE, relayed(0, "other", 7)) is None


def test_later_handles_replace_those_of_the_same_path() -> None:
    """And no others."""
    paths = RelayHandles()
    paths.assign("vps", LTE, [7])
    paths.assign("vps", MESH, [9])
    paths.assign("vps", LTE, [8])
    assert paths.wrap(ENVELOPE, relayed(0, "vps", 7)) is None
    assert paths.unwrap(0, wrap(7, ENVELOPE), LTE.address) is DropReason.RELAY_UNKNOWN_HANDLE
    assert paths.wrap(ENVELOPE, relayed(0, "vps", 8)) is not None
    paths.assign("vps", LTE, [])
    assert paths.wrap(ENVELOPE, relayed(0, "vps", 8)) is None
    assert paths.wrap(ENVELOPE, relayed(1, "vps", 9)) is not None


def test_relay_with_two_addresses_may_assign_a_handle_twice() -> None:
    """By accident, or to confuse: the first one counts, and nothing fails."""
    paths, other = RelayHandles(), Path(0, ("203.0.113.1", 5791))
    paths.assign("vps", LTE, [7])
    paths.assign("vps", other, [7, 8])
    assert paths.wrap(ENVELOPE, relayed(0, "vps", 7)) == (wrap(7, ENVELOPE), LTE.address)
    assert paths.unwrap(0, wrap(7, ENVELOPE), other.address) is DropReason.RELAY_UNKNOWN_HANDLE
    paths.assign("vps", LTE, [])
    paths.assign("vps", other, [])
    assert paths.wrap(ENVELOPE, relayed(0, "vps", 8)) is None


def test_relay_in_the_middle_takes_no_handle_of_another_relay() -> None:
    """It answers at the address of the other relay for a while. Data along the other one passes then and later."""
    paths = RelayHandles()
    paths.assign("vps", LTE, [7])
    for handles in ([9], [7], []):
        paths.assign("hostile", LTE, handles)
        assert paths.wrap(ENVELOPE, relayed(0, "vps", 7)) == (wrap(7, ENVELOPE), LTE.address)
        assert paths.unwrap(0, wrap(7, ENVELOPE), LTE.address) == (ENVELOPE, relayed(0, "vps", 7))
        assert paths.wrap(ENVELOPE, relayed(0, "hostile", 7)) is None
    assert paths.unwrap(0, wrap(9, ENVELOPE), LTE.address) is DropReason.RELAY_UNKNOWN_HANDLE


def test_handle_passes_to_the_other_relay_when_the_first_one_ends_it() -> None:
    """The relay in the middle was first. The true relay does not assign its handle again."""
    paths = RelayHandles()
    paths.assign("hostile", LTE, [7])
    paths.assign("vps", LTE, [7])
    assert paths.wrap(ENVELOPE, relayed(0, "vps", 7)) is None
    paths.assign("hostile", LTE, [])
    assert paths.wrap(ENVELOPE, relayed(0, "vps", 7)) == (wrap(7, ENVELOPE), LTE.address)
    assert paths.unwrap(0, wrap(7, ENVELOPE), LTE.address) == (ENVELOPE, relayed(0, "vps", 7))


Assignment = tuple[str, Path, list[int]]
assignments: st.SearchStrategy[Assignment] = st.tuples(
    st.sampled_from(("vps", "hostile")),
    st.sampled_from((LTE, MESH, Path(0, ("203.0.113.2", 5790)))),
    st.lists(st.integers(1, 3), max_size=3),
)


@settings(max_examples=300, deadline=None)
@given(st.lists(assignments, max_size=12))
def test_random_assignments_follow_the_rules(history: list[Assignment]) -> None:
    """Both directions agree. A relay loses no handle to another one, and gets each that no other has."""
    paths, wanted, had = RelayHandles(), dict[tuple[str, Path], list[int]](), set[tuple[str, Path, int]]()
    for relay, at, handles in history:
        paths.assign(relay, at, handles)
        wanted[relay, at] = handles
        now = {
            (name, place, handle)
            for (name, place), those in wanted.items()
            for handle in those
            if paths.unwrap(place.socket, wrap(handle, ENVELOPE), place.address)
            == (ENVELOPE, relayed(place.socket, name, handle))
        }
        for name, place, handle in now:
            assert paths.wrap(ENVELOPE, relayed(place.socket, name, handle)) == (
                wrap(handle, ENVELOPE),
                place.address,
            )
        assert len(paths._inward) == len(paths._outward) == len(now)
        assert all(handle not in wanted[name, place] for name, place, handle in had - now), "a handle was lost"
        names = {(name, place.socket, handle) for name, place, handle in now}
        places = {(place, handle) for _, place, handle in now}
        for (name, place), those in wanted.items():
            for handle in those:
                assert (name, place.socket, handle) in names or (place, handle) in places, "a handle leads nowhere"
        had = now


def test_path_to_a_relay_is_never_relayed() -> None:
    """A relay sends its own envelopes along a handle, and assigns more there: they would lead to no address."""
    paths = RelayHandles()
    paths.assign("vps", LTE, [7])
    paths.assign("vps", relayed(0, "vps", 7), [8])
    assert paths.wrap(ENVELOPE, relayed(0, "vps", 8)) is None


def test_malformed_data_is_dropped_before_its_handle_is_looked_up() -> None:
    """Nothing inside, and a relay inside a relay."""
    paths = RelayHandles()
    paths.assign("vps", LTE, [7])
    for data in (wrap(7, b""), wrap(7, wrap(7, ENVELOPE)), b"\x50"):
        assert paths.unwrap(0, data, LTE.address) is DropReason.RELAY_MALFORMED
