"""RESULTS.md from the records of flights: only what was measured, and the names of what was not flown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from tests.sitl.conditions import BY_NAME
from tests.sitl.scenarios import KINDS, Record, runs

Cells = Sequence[object]
FLOWN_KINDS = tuple(kind for kind in KINDS if kind != "own")


def report(records: list[Record]) -> str:
    """The page."""
    passed = [record for record in records if record.error is None]
    sections = [
        "# Real autopilots at the ends of real daemons",
        "Made by `python -m tests.sitl`, see [README.md](README.md). The simulators ran on the same machine, at the"
        " speed of real time, beside other work. *direct*: the same without daemons.",
        _section("Flown", ("autopilot", "version", "runs", "passed"), _flown(records)),
        _section(
            "Frames on the clean link",
            (
                *("scenario", "autopilot", "frames down / up", "lost / altered / duplicated / reordered"),
                *(
                    "withheld by the daemons",
                    "frames/s",
                    "latency p50 / p99 down",
                    "p50 direct",
                    "CPU drone / ground",
                ),
            ),
            _frames(passed),
            "Frames are compared byte for byte at the autopilot and at the station, without those that the daemons"
            " withheld by policy, with the reason. CPU is a share of one core.",
        ),
        _section(
            "Parameters, and a mission of 100 items",
            (
                *("autopilot", "condition", "parameters", "all parameters", "direct"),
                *("mission up", "direct", "mission down", "direct", "requests repeated", "direct"),
            ),
            _tables(passed),
        ),
        _section(
            "Flights: arm, take off, two guided waypoints, a mission of three waypoints, return",
            ("autopilot", "condition", "", "to the second waypoint", "mission", "return", "lost down / up"),
            _flights(passed),
        ),
        _section(
            "Log, and 1 MB by MAVFTP",
            ("autopilot", "", "log", "log", "read", "write"),
            _files(passed),
            "Equal byte for byte to the files in the simulator's folder.",
        ),
        _section(
            "Signing",
            (
                *("autopilot", "", "signed frames down / up", "unsigned down", "bad signatures"),
                *("SETUP_SIGNING withheld", "unsigned request ignored"),
            ),
            _signing(passed),
            "From parameters to a flight, all signed. The key was set on the autopilot's maintenance port.",
        ),
        _section(
            "Two vehicles, one station",
            ("autopilot", "", "parameters of each", "downloaded together in", "lost down / up"),
            _two(passed),
        ),
        _section(
            "Follow-me between two swarm members",
            ("autopilot", "", "leader flew", "until the follower was there", "distance", "messages from the leader"),
            _follow(passed),
        ),
        _section(
            "Outages, with the autopilot's failsafe for a lost ground station",
            (
                *("autopilot", "", "outage", "first frame down / up after it", "failsafe"),
                *("after the last heartbeat", "under control again"),
            ),
            _outages(passed),
            f"{failsafes()} The first frame up is the station's heartbeat, once per second.",
        ),
        _section(
            "Two radios: one dies, the other loses 30 % of its datagrams, then they change places",
            (
                "autopilot",
                "mission uploaded and flown in",
                "heartbeats of the station",
                "longest silence",
                "failsafe",
            ),
            _two_radios(passed),
        ),
        _section(
            "Through relays: the ordinary flight",
            (
                *("autopilot", "relays", "all parameters", "mission up / down", "flight", "frames down / up"),
                *("lost / altered / duplicated / reordered", "latency p50 / p99 down", "CPU drone / ground"),
            ),
            _relayed(passed),
            "The daemons have no addresses of each other, and the link is confidential. With two relays, order counts"
            " among frames of one message: a heartbeat may overtake telemetry.",
        ),
        _section(
            "Relays killed in the air",
            (
                *("autopilot", "killed", "absent", "first frame down / up after it listens"),
                *("longest gap in telemetry", "critical frames lost", "frames lost"),
                *("altered / duplicated / reordered", "failsafe"),
            ),
            _kills(passed),
            "By SIGKILL, with the failsafe on. Ten requests a second go up, so that critical frames pass in both"
            " directions. *absent*: from the kill until the relay listens again.",
        ),
        _section(
            "Restarts",
            ("autopilot", "", "what", "absent", "first frame down / up after the start"),
            _restarts(passed),
            "Daemons in the air, with the failsafe on: it did not trip. The simulator on the ground: it has a new"
            " source port, and its time counts from its first frame.",
        ),
        _section(
            "Failed",
            ("scenario", "autopilot", "condition", "", "reason"),
            [[*_name(record), (record.error or "").replace("|", "/")[:300]] for record in records if record.error],
        ),
        _section("Not flown", ("scenario", "autopilot", "conditions", ""), _not_flown(records)),
    ]
    return "\n\n".join(section for section in sections if section) + "\n"


def failsafes() -> str:
    """When the failsafe of each real autopilot trips."""
    times = []
    for kind in (KINDS[name] for name in FLOWN_KINDS if KINDS[name].failsafe):
        reason = f": {kind.failsafe_reason}" if kind.failsafe_reason else ""
        times.append(f"{kind.failsafe_s:g} s ({kind.name}{reason})")
    return f"The failsafe trips after {', '.join(times)}."


def _section(title: str, head: Cells, rows: Iterable[Cells], about: str = "") -> str:
    lines = ["| " + " | ".join(map(str, row)) + " |" for row in rows]
    if not lines:
        return ""
    table = ["| " + " | ".join(map(str, head)) + " |", "|" + "---|" * len(head), *lines]
    return "\n\n".join(part for part in (f"## {title}", about, "\n".join(table)) if part)


def _name(record: Record) -> list[str]:
    return [record.scenario, record.kind, record.condition, _how(record)]


def _how(record: Record) -> str:
    return "daemons" if record.with_daemons else "direct"


def _flown(records: list[Record]) -> Iterable[Cells]:
    for kind in KINDS:
        of_kind = [record for record in records if record.kind == kind]
        if of_kind:
            versions = sorted({record.version for record in of_kind if record.version})
            yield KINDS[kind].name, ", ".join(versions), len(of_kind), sum(r.error is None for r in of_kind)


def _not_flown(records: list[Record]) -> Iterable[Cells]:
    flown = {tuple(_name(record)) for record in records}
    missing: dict[tuple[str, str, str], list[str]] = {}
    for run in runs(FLOWN_KINDS):
        how = "daemons" if run.with_daemons else "direct"
        if (run.scenario, run.kind, run.condition, how) not in flown:
            missing.setdefault((run.scenario, run.kind, how), []).append(run.condition)
    return [(scenario, kind, ", ".join(names), how) for (scenario, kind, how), names in missing.items()]


def _of(records: list[Record], scenario: str) -> list[Record]:
    order = list(BY_NAME)
    chosen = [record for record in records if record.scenario == scenario]
    return sorted(chosen, key=lambda r: (r.kind, order.index(r.condition), not r.with_daemons))


def _twin(records: list[Record], record: Record) -> dict[str, Any]:
    """The figures of the same run without daemons; empty if it was not flown."""
    key = (record.scenario, record.kind, record.condition, False)
    return next((r.figures for r in records if (r.scenario, r.kind, r.condition, r.with_daemons) == key), {})


def _with(figures: dict[str, Any], name: str, unit: str = " s") -> str:
    value = figures.get(name)
    return "-" if value is None else f"{value:,}{unit}"


def _frames(records: list[Record]) -> Iterable[Cells]:
    for record in records:
        frames = record.figures.get("frames")
        if not frames or record.condition != "clean" or not record.with_daemons:
            continue
        down, up, cpu = frames["down"], frames["up"], frames["cpu_percent"]
        drones = [f"{share} %" for name, share in cpu.items() if name != "ground"]
        direct = _twin(records, record).get("frames", {}).get("down", {}).get("p50_ms")
        faults = [down[key] + up[key] for key in ("lost", "altered", "duplicated", "reordered")]
        yield (
            *(record.scenario, record.kind, f"{down['sent']:,} / {up['sent']:,}", " / ".join(map(str, faults))),
            *(
                ", ".join(f"{count} {what}" for what, count in frames["withheld"].items()) or "-",
                frames["frames_s"],
                f"{down['p50_ms']} / {down['p99_ms']} ms",
                "-" if direct is None else f"{direct} ms",
            ),
            f"{', '.join(drones)} / {cpu['ground']} %",
        )


def _tables(records: list[Record]) -> Iterable[Cells]:
    for record in _of(records, "parameters-mission"):
        if record.with_daemons:
            own, direct = record.figures, _twin(records, record)
            pairs = [
                _with(figures, name)
                for name in ("parameters_s", "mission_up_s", "mission_down_s")
                for figures in (own, direct)
            ]
            repeated = [sum(f["retries"].values()) if f else "-" for f in (own, direct)]
            yield record.kind, record.condition, own["parameters"], *pairs, *repeated


def _flights(records: list[Record]) -> Iterable[Cells]:
    for record in _of(records, "flight"):
        f = record.figures
        yield (
            *(record.kind, record.condition, _how(record)),
            *(_with(f, name) for name in ("guided_s", "mission_s", "return_s")),
            _lost(record),
        )


def _lost(record: Record) -> str:
    frames = record.figures["frames"]
    return " / ".join(f"{frames[way]['lost']:,} of {frames[way]['sent']:,}" for way in ("down", "up"))


def _files(records: list[Record]) -> Iterable[Cells]:
    for record in _of(records, "log-file"):
        f = record.figures
        yield (
            *(record.kind, _how(record), _with(f, "log_bytes", " bytes"), _with(f, "log_kb_s", " kB/s")),
            *(_with(f, name, " kB/s") for name in ("ftp_read_kb_s", "ftp_write_kb_s")),
        )


def _signing(records: list[Record]) -> Iterable[Cells]:
    for record in _of(records, "signing"):
        f = record.figures
        yield (
            *(record.kind, _how(record), f"{f['signed_down']:,} / {f['signed_up']:,}", f["unsigned_down"]),
            *(f["bad_signatures"], f["setup_signing_withheld"], "yes" if f["unsigned_request_ignored"] else "no"),
        )


def _two(records: list[Record]) -> Iterable[Cells]:
    for record in _of(records, "two-vehicles"):
        f = record.figures
        yield (
            *(record.kind, _how(record), ", ".join(map(str, f["parameters"]))),
            *(f"{max(f['parameters_s'])} s", _lost(record)),
        )


def _follow(records: list[Record]) -> Iterable[Cells]:
    for record in _of(records, "follow-me"):
        f = record.figures
        names = f["messages_from_leader"]
        shown = ", ".join(names) if record.with_daemons else f"{len(names)} kinds"
        yield (
            *(record.kind, _how(record), f"{f['lead_m']:g} m", f"{f['seconds']} s"),
            *(f"{f['distance_m'][0]} to {f['distance_m'][1]} m, {f['final_distance_m']} m at the end",),
            f"{f['frames_from_leader']:,}: {shown}",
        )


def _outages(records: list[Record]) -> Iterable[Cells]:
    for record in _of(records, "outages"):
        for o in record.figures["outages"]:
            yield (
                *(
                    record.kind,
                    _how(record),
                    f"{o['seconds']:g} s",
                    f"{o['frames_back_s']} / {o['station_back_s']} s",
                ),
                *("tripped" if o["failsafe"] else "did not trip", _with(o, "failsafe_after_s")),
                f"{o['control_after_s']} s",
            )


def _two_radios(records: list[Record]) -> Iterable[Cells]:
    for record in _of(records, "two-radios"):
        f = record.figures
        yield (
            *(record.kind, f"{f['mission_s']} s", f["heartbeats"], f"{f['longest_silence_s']} s"),
            "tripped" if f["other_modes"] else "did not trip",
        )


def _relayed(records: list[Record]) -> Iterable[Cells]:
    for record in records:
        if "kills" in record.figures:
            f, tables = record.figures, record.figures["tables"]
            parts = (tables["frames"], f["frames"])
            sent = [sum(part[way]["sent"] for part in parts) for way in ("down", "up")]
            faults = (
                sum(part[way][fault] for part in parts for way in ("down", "up"))
                for fault in ("lost", "altered", "duplicated", "reordered")
            )
            down, cpu = f["frames"]["down"], f["frames"]["cpu_percent"]
            yield (
                *(record.kind, f["relays"], f"{tables['parameters']:,} in {tables['parameters_s']} s"),
                f"{tables['mission_up_s']} / {tables['mission_down_s']} s",
                f"{f['guided_s'] + f['mission_s'] + f['return_s']:.1f} s",
                *(f"{sent[0]:,} / {sent[1]:,}", " / ".join(map(str, faults))),
                f"{down['p50_ms']} / {down['p99_ms']} ms",
                f"{cpu['drone1']} / {cpu['ground']} %",
            )


def _kills(records: list[Record]) -> Iterable[Cells]:
    for record in records:
        for kill in record.figures.get("kills", ()):
            back = f"{kill['down_back_s']} / {kill['up_back_s']} s" if "down_back_s" in kill else "-"
            yield (
                *(record.kind, kill["what"], _with(kill, "absent_s"), back, f"{kill['stream_gap_s']} s"),
                f"{kill['critical_lost']} of {kill['critical_sent']:,}",
                f"{kill['lost']:,} of {kill['sent']:,}",
                " / ".join(str(kill[fault]) for fault in ("altered", "duplicated", "reordered")),
                "tripped" if kill["failsafe"] else "did not trip",
            )


def _restarts(records: list[Record]) -> Iterable[Cells]:
    for record in _of(records, "restarts"):
        for r in record.figures["restarts"]:
            back = f"{r['down_back_s']} / {r['up_back_s']} s"
            yield record.kind, _how(record), r["what"], _with(r, "absent_s"), back
