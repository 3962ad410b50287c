"""Records of timing as a run would leave them, with numbers that a test can check by hand."""

from __future__ import annotations

from uavlinkd.lab.evaluation.records import Record, Status, Value
from uavlinkd.lab.evaluation.timing_report import TimingFindings


def paper(bits: int, length: int, total_s: float, group: str = "made") -> Record:
    """One exchange of the paper's method; nine tenths of it for its parameters."""
    point: dict[str, Value] = {"dh_bits": bits, "mac_key_bits": length, "group": group}
    return Record("paper", point, {"total_s": total_s, "parameters_s": 0.9 * total_s})


def handshake(suite: str, length: int, total_s: float) -> Record:
    values = {"total_s": total_s, "cpu_initiator_s": 0.002, "cpu_responder_s": 0.004}
    return Record("handshake", _link(suite, length), {**values, "bytes": [700, 600], "datagrams": [3, 2]})


def _link(suite: str, length: int) -> dict[str, Value]:
    return {"suite": suite, "mac_key_bits": length}


def not_finished(bits: int, length: int) -> Record:
    """An exchange that took too long."""
    point: dict[str, Value] = {"dh_bits": bits, "mac_key_bits": length, "group": "made"}
    return Record("paper", point, {"limit_s": 600.0}, Status.NOT_FINISHED, "not finished in 600 s")


def a_run(*more: Record) -> TimingFindings:
    """A whole small run, and more records."""
    records = [
        *(
            paper(bits, length, seconds * k)
            for bits, seconds in ((512, 0.1), (2048, 20.0))
            for length in (512, 1024)
            for k in (1, 2, 3)
        ),
        not_finished(4096, 512),
        *(paper(2048, 512, 0.004 * k, "standard") for k in (1, 2, 3)),
        *(
            Record("core", _link(suite, length), {"initiate_s": 0.001})
            for suite in ("x25519", "ffdhe2048")
            for length in (256, 512)
        ),
        *(handshake("x25519", length, 0.003 * k) for length in (256, 512) for k in (1, 2, 3)),
        *(handshake("ffdhe2048", length, 0.009 * k) for length in (256, 512) for k in (1, 2, 3)),
        *(handshake("ffdhe4096", 256, 0.019 * k) for k in (1, 2, 3)),
        *(Record("mac", {"mac_key_bits": bits, "message_bytes": 45}, {"tag_least_s": 1e-6}) for bits in (256, 2048)),
        Record("end", {}, {"elapsed_s": 90.0}),
    ]
    return TimingFindings({"quick": True}, [*records, *more])
