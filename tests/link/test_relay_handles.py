"""Handles on paths to relays: only those that were assigned lead somewhere, in both directions."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from uavlinkd.core.drops import DropReason
from uavlinkd.core.path import Path, relayed
from uavlinkd.core.relay_records import wrap
from uavlinkd.link.relay_link import RelayHandles

LTE, MESH = Path(0, ("203.0.113.1", 5790)), Path(1, ("203.0.113.1", 5790))
ENVELOPE = b"\x40envelope"


Assignment = tuple[str, Path, list[int]]
assignments: st.SearchStrategy[Assignment] = st.tuples(
    st.sampled_from(("vps", "hostile")),
    st.sampled_from((LTE, MESH, Path(0, ("203.0.113.2", 5790)))),
    st.lists(st.integers(1, 3), max_size=3),
)


@settings(max_examples=300)
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
