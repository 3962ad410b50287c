"""The tables of the timing report, made from its records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from statistics import median

from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.lab.evaluation.dependence import p_value
from uavlinkd.lab.evaluation.energy import BOARDS, frames_joules, handshake_joules
from uavlinkd.lab.evaluation.figures import latency_links
from uavlinkd.lab.evaluation.page import Table
from uavlinkd.lab.evaluation.records import Status, Value
from uavlinkd.lab.evaluation.spread import duration, spread
from uavlinkd.lab.evaluation.timing_queries import DAEMON_SIZES, Findings, percentile

_NOTHING = "-"
_LEVEL = 0.05
"""Probability of a false dependence, for all groups together (Bonferroni)."""


def _cell(times: Sequence[float]) -> str:
    return str(spread(times)) if times else _NOTHING


def _median(findings: Findings, kind: str, name: str, suite: str) -> str:
    times = findings.spread(kind, name, suite=suite)
    return duration(times.median) if times else _NOTHING


def _change(seconds: float) -> str:
    return ("+" if seconds >= 0 else "-") + duration(abs(seconds))


def _ratio(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.1f}"


def _state(findings: Findings, **point: int | str) -> str:
    """The reason for a missing number in the paper's grid."""
    records = findings.of("paper", **point)
    reasons = Counter(f"{record.status.value}: {record.reason}" for record in records if not record.is_ok)
    return "; ".join(f"{reason} ({count})" for reason, count in reasons.items()) or _NOTHING


def comparison(findings: Findings) -> Table:
    """Both methods, by the size of the group."""
    by_size = {bits: suite for suite, bits in DAEMON_SIZES.items()}
    sizes = sorted({*(int(str(bits)) for bits in findings.values("paper", "dh_bits")), *by_size})
    rows = []
    for bits in sizes:
        finished, suite = findings.paper_times("made", bits), by_size.get(bits)
        ours = findings.daemon_times(suite) if suite else []
        all_times = findings.paper_at_least("made", bits)
        late = len(all_times) - len(finished)
        paper = _state(findings, group="made", dh_bits=bits)
        if finished:
            paper = str(spread(all_times)) + (f", {late} not finished and counted as the limit" if late else "")
        factor = _NOTHING
        if all_times and ours:
            factor = f"{'at least ' if late else ''}{_ratio(spread(all_times).median / spread(ours).median)}"
        rows.append(
            [
                str(bits),
                paper,
                _search_share(findings, bits),
                _cell(findings.paper_times("standard", bits)),
                _cell(ours) if suite else "refused: too small",
                factor,
            ]
        )
    head = [
        "bits",
        "the paper's method",
        "search of the prime",
        "the same in RFC 7919's group",
        "uavlinkd, ffdhe of that size",
        "factor",
    ]
    return Table(head, rows)


def _search_share(findings: Findings, bits: int) -> str:
    records = [record for record in findings.of("paper", group="made", dh_bits=bits) if record.is_ok]
    shares = [record.number("parameters_s") / record.number("total_s") for record in records]
    return f"{100 * median(shares):.0f} %" if shares else _NOTHING


def dependence(findings: Findings) -> Table:
    """Whether the time depends on the length of the HMAC key, in both grids."""
    lengths = findings.values("paper", "mac_key_bits")
    groups = [
        (f"{bits} bits in the paper's method", [findings.paper_at_least("made", bits, length) for length in lengths])
        for bits in findings.values("paper", "dh_bits")
        if findings.paper_times("made", bits)
    ]
    lengths = findings.values("handshake", "mac_key_bits")
    groups += [(suite, [findings.daemon_times(suite, length) for length in lengths]) for suite in findings.suites()]
    tested = {name: p_value(times) for name, times in groups if sum(len(sample) > 1 for sample in times) > 1}
    dependent = [name for name, value in tested.items() if value < _LEVEL / len(tested)]
    least = f"{min(tested.values()):.2g}" if tested else "too few repetitions"
    row = [str(len(tested)), str(len(dependent)), ", ".join(dependent) or _NOTHING, least]
    return Table(["groups tested", "dependent", "which", "smallest p"], [row])


def extremes(findings: Findings) -> Table:
    """The range of each method, and its widest group."""
    rows = []
    for title, groups in (
        (
            "the paper's method",
            [(f"{bits} bits", findings.paper_times("made", bits)) for bits in findings.values("paper", "dh_bits")],
        ),
        ("uavlinkd", [(suite, findings.daemon_times(suite)) for suite in findings.suites()]),
    ):
        spreads = [(name, spread(times)) for name, times in groups if len(times) > 1]
        if spreads:
            name, widest = max(spreads, key=lambda item: item[1].ratio)
            times = [time for _, part in groups for time in part]
            extremes = [duration(min(times)), duration(max(times))]
            rows.append([title, str(len(times)), *extremes, name, _ratio(widest.ratio)])
    return Table(["method", "exchanges", "shortest", "longest", "widest group", "longest / shortest in it"], rows)


def tag_times(findings: Findings) -> Table:
    """The time of a tag by the length of its key."""
    rows = []
    for message in findings.values("mac", "message_bytes"):
        prepared, unprepared = (_tag_times(findings, message, states) for states in ("prepared", "from the key"))
        if len(prepared) < 2 or not {512, 520} <= set(unprepared):
            continue
        least, most = min(prepared.values()), max(prepared.values())
        shortest, longest = unprepared[min(unprepared)], unprepared[max(unprepared)]
        steps = (unprepared[512] - shortest, unprepared[520] - unprepared[512], longest - unprepared[520])
        difference = f"{duration(least)} to {duration(most)} ({100 * (most / least - 1):.0f} %)"
        rows.append([f"{message} bytes", difference, *map(_change, steps)])
    head = ["message", "prepared, all lengths", "from the key: 256 to 512", "512 to 520", "520 to 2048"]
    return Table(head, rows)


def _tag_times(findings: Findings, message_bytes: Value, states: str) -> dict[int, float]:
    times: dict[int, float] = {}
    for bits in findings.values("mac", "mac_key_bits"):
        point: dict[str, Value] = {"mac_key_bits": bits, "states": states, "message_bytes": message_bytes}
        for seconds in findings.numbers("mac", "tag_least_s", **point)[:1]:
            times[int(str(bits))] = seconds
    return times


def latencies(findings: Findings) -> Table:
    """The quantiles of the latency on each link."""
    rows = []
    for name, times in latency_links(findings):
        quantiles = [percentile(times, share) for share in (0.5, 0.99, 1.0)]
        rows.append([name, str(len(times)), *map(duration, quantiles)])
    return Table(["link", "frames", "half within", "99 % within", "all within"], rows)


def relay_delay(findings: Findings) -> Table:
    """The delay that the counting relay adds."""
    point: dict[str, Value] = {"suite": "x25519", "mac_key_bits": 256, "confidential": False}
    with_relay, without = findings.latencies(relay=True, **point), findings.latencies(relay=False, **point)
    rows = []
    if with_relay and without:
        delay = percentile(with_relay, 0.5) - percentile(without, 0.5)
        rows = [[_change(delay), _change(4 * delay)]]
    return Table(["relay: change of the median of a frame's time", "the same for four datagrams"], rows)


def energy(findings: Findings) -> Table:
    """The assumptions and measurements of energy."""
    joules = findings.spread("handshake", "joules")
    measured = f"{joules.median:.3g} J per handshake" if joules else "not available on this machine"
    rows = [
        ["power of a busy core, assumed", f"{findings.run.get('watts_per_core')} W"],
        ["energy counters of the processor (RAPL), everything that runs", measured],
    ]
    return Table(["", ""], rows)


def boards() -> Table:
    """The power of typical boards."""
    rows = [[board.name, f"{board.watts_per_core:.2f} W", board.source] for board in BOARDS]
    return Table(["board", "one busy core adds", "source"], rows)


def paper_grid(findings: Findings) -> Table:
    """All points of the paper's grid."""
    rows = []
    for group in ("made", "standard"):
        for bits in findings.values("paper", "dh_bits"):
            for length in findings.values("paper", "mac_key_bits"):
                if not findings.of("paper", group=group, dh_bits=bits, mac_key_bits=length):
                    continue
                times = findings.paper_times(group, bits, length)
                with_late = findings.paper_at_least(group, bits, length)
                made = findings.spread("paper", "parameters_s", group=group, dh_bits=bits, mac_key_bits=length)
                gap = _state(findings, group=group, dh_bits=int(str(bits)), mac_key_bits=int(str(length)))
                rows.append(
                    [
                        "made" if group == "made" else "RFC 7919",
                        str(bits),
                        str(length),
                        _cell(with_late) if times else gap,
                        duration(made.median) if made else _NOTHING,
                        gap if times else "",
                    ]
                )
    head = [
        "group",
        "bits",
        "HMAC key (bits)",
        "start to verified (the limit if not finished)",
        "generating parameters, median",
        "not finished, failed",
    ]
    return Table(head, rows)


def suites(findings: Findings) -> Table:
    """The cost of each suite."""
    rows = []
    for suite in findings.suites():
        handshakes = [record for record in findings.of("handshake", suite=suite) if record.is_ok]
        wire = Counter(
            tuple(
                int(record.number(name))
                for name in ("bytes_there", "bytes_back", "datagrams_there", "datagrams_back")
            )
            for record in handshakes
        ).most_common(1)
        there, back, datagrams_there, datagrams_back = wire[0][0] if wire else (0, 0, 0, 0)
        joules = handshake_joules(findings, suite)
        frames = frames_joules(findings, suite=suite, mac_key_bits=256, confidential=False)
        rows.append(
            [
                suite,
                _cell(findings.daemon_times(suite)),
                _cell(findings.rekey_times(suite)),
                _median(findings, "handshake", "cpu_initiator_s", suite),
                _median(findings, "handshake", "cpu_responder_s", suite),
                f"{there} + {back}" if wire else _NOTHING,
                f"{datagrams_there} + {datagrams_back}" if wire else _NOTHING,
                f"{1e3 * joules:.2f} mJ" if joules is not None else _NOTHING,
                f"{1e3 * frames:.0f} mJ" if frames is not None else _NOTHING,
            ]
        )
    head = [
        "suite",
        "handshake, all HMAC keys",
        "rekey",
        "CPU, initiator",
        "CPU, responder",
        "bytes sent + received, with the first frame",
        "datagrams",
        "energy of a handshake (estimate)",
        "energy of 1,000 frames (estimate)",
    ]
    return Table(head, rows)


def by_mac_key(findings: Findings) -> Table:
    """The handshakes of each suite, by the length of the HMAC key."""
    lengths = findings.values("handshake", "mac_key_bits")
    rows = [
        [suite, *(_cell(findings.daemon_times(suite, length)) for length in lengths)] for suite in findings.suites()
    ]
    return Table(["handshake", *(f"HMAC key of {length} bits" for length in lengths)], rows)


def core_steps(findings: Findings) -> Table:
    """The steps of a handshake in the core."""
    steps = {
        "initiate_s": "make the initiation",
        "respond_s": "respond",
        "finish_s": "process the response",
        "confirm_s": "process the confirmation",
        "frame_s": "seal and open a frame",
        "total_s": "all",
    }
    suites = [name for name in SUITES_BY_NAME if findings.of("core", suite=name)]
    rows = [[suite, *(_median(findings, "core", step, suite) for step in steps)] for suite in suites]
    return Table(["suite", *steps.values()], rows)


def frames(findings: Findings) -> Table:
    """Latency and processor time on each link."""
    rows = []
    for record in findings.records:
        if record.kind != "frames" or not record.is_ok:
            continue
        point = dict(record.point)
        latencies = findings.latencies(**point)
        per_frame = [record.number(name) / record.number("sent") for name in ("cpu_initiator_s", "cpu_responder_s")]
        rows.append(
            [
                str(point["suite"]),
                "confidential" if point["confidential"] else f"{point['mac_key_bits']} bits",
                "yes" if point["relay"] else "no",
                f"{record.number('delivered'):.0f} of {record.number('sent'):.0f}",
                _cell(latencies),
                duration(per_frame[0]),
                duration(per_frame[1]),
            ]
        )
    return Table(
        ["suite", "HMAC key", "relay", "delivered", "latency", "CPU per frame, initiator", "CPU, responder"], rows
    )


def gaps(findings: Findings) -> list[Table]:
    """The points without a measurement."""
    counts = Counter(
        (record.status, record.kind, ", ".join(f"{k} {v}" for k, v in record.point.items()), record.reason)
        for record in findings.unfinished()
    )
    order = {Status.FAILED: 0, Status.NOT_FINISHED: 1, Status.SKIPPED: 2, Status.OK: 3}
    rows = [
        [status.value, kind, point, reason, str(count)]
        for (status, kind, point, reason), count in sorted(counts.items(), key=lambda item: order[item[0][0]])
    ]
    return [Table(["status", "kind", "point", "reason", "count"], rows)] if rows else []


def run_facts(findings: Findings) -> Table:
    """The machine and the options of the run."""
    rows = [
        [name.replace("_", " "), _NOTHING if value is None else str(value)] for name, value in findings.run.items()
    ]
    end = findings.of("end")
    if end:
        rows.append(["elapsed s", f"{end[0].number('elapsed_s'):.0f}"])
        rows.append(["load after", str(end[0].values.get("load_after", _NOTHING))])
    return Table(["", ""], rows)
