"""Records as a run would leave them, with numbers that a test can check by hand."""

from __future__ import annotations

from uavlinkd.lab.evaluation.records import Record, Status, Value
from uavlinkd.lab.evaluation.timing_queries import Findings

RUN: dict[str, Value] = {
    "cpu": "a test",
    "seed": 7,
    "repeats": 3,
    "limit_s": 600.0,
    "watts_per_core": 0.5,
    "uvloop": None,
}


def paper(bits: int, length: int, total_s: float, group: str = "made") -> Record:
    """One exchange of the paper's method; nine tenths of it, where the group is made, for its parameters."""
    share = 0.9 if group == "made" else 0.01
    point: dict[str, Value] = {"dh_bits": bits, "mac_key_bits": length, "group": group}
    return Record("paper", point, {"total_s": total_s, "parameters_s": share * total_s})


def handshake(suite: str, length: int, total_s: float) -> Record:
    """One handshake of daemons."""
    point: dict[str, Value] = {"suite": suite, "mac_key_bits": length, "confidential": False}
    wire = {"bytes_there": 700, "bytes_back": 600, "datagrams_there": 3, "datagrams_back": 2}
    cpu = {"cpu_initiator_s": 0.002, "cpu_responder_s": 0.004, "joules": None}
    return Record("handshake", point, {"total_s": total_s, **cpu, **wire})


def core(suite: str, length: int, initiate_s: float) -> Record:
    """One handshake of nodes."""
    point: dict[str, Value] = {"suite": suite, "mac_key_bits": length, "confidential": False}
    return Record("core", point, {"initiate_s": initiate_s, "total_s": 4 * initiate_s})


def frames(latencies_ms: list[float], *, relay: bool = False) -> Record:
    """A link's frames."""
    point: dict[str, Value] = {"suite": "x25519", "mac_key_bits": 256, "confidential": False, "relay": relay}
    count = len(latencies_ms)
    cpu = {"cpu_initiator_s": 0.0001 * count, "cpu_responder_s": 0.0003 * count}
    latencies = [milliseconds / 1000 for milliseconds in latencies_ms]
    return Record("frames", point, {"sent": count, "delivered": count, **cpu, "latency_s": latencies})


def tag(length: int, states: str, tag_s: float) -> Record:
    """What a tag cost."""
    point: dict[str, Value] = {"mac_key_bits": length, "states": states, "message_bytes": 45}
    return Record("mac", point, {"tag_s": tag_s, "tag_least_s": tag_s})


def not_finished(bits: int, length: int) -> Record:
    """An exchange that took too long."""
    point: dict[str, Value] = {"dh_bits": bits, "mac_key_bits": length, "group": "made"}
    return Record("paper", point, {"limit_s": 600.0}, Status.NOT_FINISHED, "not finished in 600 s")


def a_run(*more: Record) -> Findings:
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
        *(core(suite, length, 0.001) for suite in ("x25519", "ffdhe2048") for length in (256, 512)),
        *(handshake("x25519", length, 0.003 * k) for length in (256, 512) for k in (1, 2, 3)),
        *(handshake("ffdhe2048", length, 0.009 * k) for length in (256, 512) for k in (1, 2, 3)),
        *(handshake("ffdhe4096", 256, 0.019 * k) for k in (1, 2, 3)),
        Record("rekey", {"suite": "x25519", "mac_key_bits": 256, "confidential": False}, {"total_s": 0.002}),
        frames([0.4, 0.5, 0.6]),
        frames([0.5, 0.6, 0.7], relay=True),
        *(tag(length, "prepared", 1e-6) for length in (256, 512, 520, 2048)),
        *(
            tag(length, "from the key", seconds)
            for length, seconds in ((256, 2e-6), (512, 2e-6), (520, 2.3e-6), (2048, 2.9e-6))
        ),
        Record("end", {}, {"elapsed_s": 90.0}),
    ]
    return Findings(RUN, [*records, *more])


FAILED = Record(
    "handshake", {"suite": "mlkem768", "mac_key_bits": 256}, {}, Status.FAILED, "no session <within> 20 s"
)
