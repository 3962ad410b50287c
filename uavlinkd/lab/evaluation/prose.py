"""A paragraph on each figure, written from the records: every number and every verdict in it is computed."""

from __future__ import annotations

from itertools import pairwise

from uavlinkd.lab.evaluation.dependence import p_value
from uavlinkd.lab.evaluation.energy import BOARDS, estimated_joules
from uavlinkd.lab.evaluation.figures import latency_links
from uavlinkd.lab.evaluation.timing_queries import DAEMON_SIZES, Findings, percentile
from uavlinkd.lab.evaluation.records import Value
from uavlinkd.lab.evaluation.spread import Spread, duration, spread

_TAGS_IN_AN_EXCHANGE = 10
"""More than there are: those of one frame, one confirmation and one answer, made and checked."""
_ENOUGH_FOR_QUARTILES = 5
_OWN_LOAD = 2
_MOST = 0.5
_LEVEL = 0.05
"""How often a verdict of dependence may be chance, for all groups together (Bonferroni)."""
_NOTICEABLE = 0.1
"""A difference of less than a tenth is called none: the machine's own noise is as large."""


def on_the_machine(findings: Findings) -> list[str]:
    """A warning, where other work may have been in the way."""
    cores, before = findings.run.get("cores"), findings.run.get("load_before")
    after = [each.values.get("load_after") for each in findings.of("end")]
    loads = [each for each in (before, *after) if isinstance(each, int | float)]
    # The run itself keeps one core busy, and two when both ends of an exchange compute.
    if not isinstance(cores, int) or not loads or max(loads) <= max(cores, _OWN_LOAD):
        return []
    return [
        f"Other work was in the way: the load was up to {max(loads):g} on {cores} cores. Times between events are "
        "longer than on an idle machine, and their spread wider; processor times suffer less. The limit on an "
        "exchange is of time passed: where the paper's method reached it, a factor is one of this machine on that "
        "day."
    ]


def on_comparison(findings: Findings) -> list[str]:
    """Paper's method and uavlinkd's at equal size of the group, and why they differ."""
    said = []
    for suite, bits in DAEMON_SIZES.items():
        ours = findings.daemon_times(suite)
        theirs = findings.paper_times("made", bits)
        if not ours:
            continue
        us = spread(ours)
        here = f"uavlinkd's {suite} takes {with_spread(us)}"
        if theirs:
            them = spread(findings.paper_at_least("made", bits))
            late = them.count - len(theirs)
            said.append(
                f"At {bits} bits the paper's method takes {with_spread(them)}{not_finished(late)}; {here}: "
                f"{'at least ' if late else ''}{_times(them, us)}."
            )
        elif limits := findings.paper_at_least("made", bits):
            said.append(
                f"At {bits} bits the paper's method did not finish within {min(limits):g} s in any of {len(limits)} "
                f"tries; {here}: at least {min(limits) / us.median:.0f} times less."
            )
        elif findings.of("paper", group="made", dh_bits=bits):
            said.append(f"At {bits} bits the paper's method was not run; {here}.")
    largest = findings.daemon_times("ffdhe8192")
    if largest:
        said.append(f"The largest group, ffdhe8192, takes {with_spread(spread(largest))}.")
    return [each for each in (" ".join(said), *on_the_cause(findings)) if each]


def on_the_cause(findings: Findings) -> list[str]:
    """Where the paper's time goes."""
    said, medians = [], []
    for bits in findings.values("paper", "dh_bits"):
        made = findings.spread("paper", "parameters_s", group="made", dh_bits=bits)
        total = findings.spread("paper", "total_s", group="made", dh_bits=bits)
        if made and total:
            shares = [
                each.number("parameters_s") / each.number("total_s")
                for each in findings.of("paper", group="made", dh_bits=bits)
                if each.is_ok
            ]
            medians.append(spread(shares).median)
            few = "once" if made.count == 1 else f"n = {made.count}"
            range_ = f"longest {_ratio(made)} times the shortest" if made.count >= _ENOUGH_FOR_QUARTILES else few
            said.append(f"{100 * medians[-1]:.0f} % at {bits} bits ({range_})")
    if not said:
        return []
    if max(medians) > _MOST:
        text = "The paper's time is the search for a safe prime, by chance, anew for every exchange."
    else:
        text = "The search for a safe prime is not the most of the paper's time in this run."
    text += f" Of the whole exchange it takes a median of {', '.join(said)}."
    text += "".join(_in_a_standard_group(findings, suite, bits) for suite, bits in DAEMON_SIZES.items())
    text += (
        " A standard group gives up nothing for that. One long computation in advance against a group that many "
        "share (Logjam) is within reach up to 1024 bits, and far out of it from 2048."
    )
    return [text]


def _in_a_standard_group(findings: Findings, suite: str, bits: int) -> str:
    standard, ours = findings.paper_times("standard", bits), findings.daemon_times(suite)
    if not standard:
        return ""
    same = spread(standard)
    text = f" The very same exchange in RFC 7919's group of {bits} bits, which is there already, takes "
    text += with_spread(same)
    if ours and spread(ours).median <= same.median:
        text += f", longer than {suite} in uavlinkd"
    elif ours:
        text += (
            f": {_times(spread(ours), same, 'shorter than')} {suite} in uavlinkd, which also authenticates both ends"
        )
    return text + "."


def on_scatter(findings: Findings) -> list[str]:
    """Whether time depends on the length of the HMAC key, in both grids."""
    mac_lengths = findings.values("paper", "mac_key_bits")
    grids = [
        (f"{bits} bits in the paper's method", [findings.paper_at_least("made", bits, each) for each in mac_lengths])
        for bits in findings.values("paper", "dh_bits")
        if findings.paper_times("made", bits)
    ]
    lengths = findings.values("handshake", "mac_key_bits")
    grids += [(suite, [findings.daemon_times(suite, each) for each in lengths]) for suite in findings.suites()]
    text = (
        "Each point is one exchange; the colours, the sizes of the groups, lie in layers, and along the axis is the "
        "length of the HMAC key. "
    )
    tested = {name: p_value(samples) for name, samples in grids if sum(len(each) > 1 for each in samples) > 1}
    if not tested:
        return [text + "This run has too few repetitions to say whether it matters."]
    level = _LEVEL / len(tested)
    apart = [name for name, value in tested.items() if value < level]
    text += (
        f"In {len(tested) - len(apart)} of {len(tested)} groups the time does not depend on it, as far as a "
        f"permutation test on ranks can tell (level {_LEVEL:.0%} for all of them together, least p "
        f"{min(tested.values()):.2g}). "
    )
    if not apart:
        return [text.rstrip()]
    return [text + f"It does in {', '.join(apart)}. " + _what_tags_explain(findings)]


def _what_tags_explain(findings: Findings) -> str:
    costs = findings.numbers("mac", "tag_s")
    exchanges = findings.numbers("handshake", "total_s") + findings.numbers("paper", "total_s")
    if not costs or not exchanges:
        return "Tags were not measured."
    share = _TAGS_IN_AN_EXCHANGE * max(costs) / min(exchanges)
    text = (
        f"The dearest tag of all takes {duration(max(costs))}; {_TAGS_IN_AN_EXCHANGE} of them would be "
        f"{100 * share:.1f} % of the shortest exchange: "
    )
    if share < _NOTICEABLE:
        return text + "the length of the key is not the cause, but chance in the search for primes, or the machine."
    return text + "the length of the key may be a part of the cause."


def on_histogram(findings: Findings) -> list[str]:
    """How wide the times of each method spread."""
    said = []
    for title, pairs in (
        ("The paper's method", [(f"{b} bits", findings.paper_times("made", b)) for b in _sizes(findings)]),
        ("uavlinkd", [(suite, findings.daemon_times(suite)) for suite in findings.suites()]),
    ):
        spreads = [(name, spread(times)) for name, times in pairs if len(times) > 1]
        if spreads:
            name, widest = max(spreads, key=lambda each: each[1].ratio)
            all_times = [time for _, times in pairs for time in times]
            said.append(
                f"{title}: {len(all_times)} exchanges between {duration(min(all_times))} and "
                f"{duration(max(all_times))}; within one group the widest is {name}, whose longest is "
                f"{_ratio(widest)} times its shortest."
            )
    return [" ".join(said) or "This run has too few repetitions for a spread."]


def _sizes(findings: Findings) -> list[Value]:
    return findings.values("paper", "dh_bits")


def on_tags(findings: Findings) -> list[str]:
    """Whether the length of the key matters to a tag, and where."""
    texts = []
    for message in findings.values("mac", "message_bytes"):
        cost = {
            states: {
                int(str(bits)): found[0]
                for bits in findings.values("mac", "mac_key_bits")
                if (
                    found := findings.numbers(
                        "mac", "tag_least_s", mac_key_bits=bits, states=states, message_bytes=message
                    )
                )
            }
            for states in ("prepared", "from the key")
        }
        prepared, unprepared = cost["prepared"], cost["from the key"]
        if len(prepared) < 2 or not {512, 520} <= set(unprepared):
            continue
        width = max(prepared.values()) / min(prepared.values()) - 1
        verdict = "does not matter" if width < _NOTICEABLE else "seems to matter"
        step = unprepared[520] - unprepared[512]
        beyond = unprepared[max(unprepared)] - unprepared[520]
        within = unprepared[512] - unprepared[min(unprepared)]
        texts.append(
            f"For a message of {message} bytes the length of the key {verdict} once a session's states are prepared, "
            f"as uavlinkd has them: {duration(min(prepared.values()))} to {duration(max(prepared.values()))}, a "
            f"difference of {100 * width:.0f} %. With the key taken anew for each tag, 256 to 512 bits change it by "
            f"{_signed(within)}, one byte more than the hash's block of 512 bits by {_signed(step)}, and 2048 bits "
            f"instead of 520 by {_signed(beyond)}."
        )
    if not texts:
        return ["Tags were not measured at enough lengths of keys."]
    texts.append(
        "RFC 2104 says why: HMAC pads a key to the hash's block, so up to 512 bits all cost the same, and hashes a "
        "longer one first, so beyond that the cost is the extra blocks of the key, and the key in effect is its "
        "hash of 256 bits: a longer key is no stronger. Prepared states hold the key already absorbed, whatever its "
        "length was."
    )
    return texts


def _signed(seconds: float) -> str:
    return ("+" if seconds >= 0 else "-") + duration(abs(seconds))


def on_latency(findings: Findings) -> list[str]:
    """How late frames are on an established link, and what the relay of the measurement adds."""
    said = []
    for name, times in latency_links(findings):
        said.append(
            f"{name}: half of {len(times)} frames within {duration(percentile(times, 0.5))}, 99 % within "
            f"{duration(percentile(times, 0.99))}, the last after {duration(max(times))}"
        )
    if not said:
        return ["No frame was measured."]
    texts = ["From program to program, through both daemons, one frame at a time. " + "; ".join(said) + "."]
    point: dict[str, Value] = {"suite": "x25519", "mac_key_bits": 256, "confidential": False}
    with_relay, without = findings.latencies(relay=True, **point), findings.latencies(relay=False, **point)
    if with_relay and without:
        added = percentile(with_relay, 0.5) - percentile(without, 0.5)
        if added <= 0:
            return [*texts, "What the counting relay adds to that is lost in the noise of this run."]
        texts.append(
            f"The counting relay adds {_signed(added)} to the median of a frame's time. A handshake's measurement "
            f"has four datagrams through it (initiation, response, confirmation, frame), so {_signed(4 * added)} of "
            "each handshake's time is the measurement's own; it is not subtracted."
        )
    return texts


def on_suites(findings: Findings) -> list[str]:
    """Which suite costs what."""
    times = [(suite, spread(each)) for suite in findings.suites() if (each := findings.daemon_times(suite))]
    if not times:
        return ["No handshake was measured."]
    ordered = sorted(times, key=lambda each: each[1].median)
    quickest, slowest = ordered[0], ordered[-1]
    text = (
        f"The quickest suite is {quickest[0]}, {duration(quickest[1].median)}; the slowest {slowest[0]}, "
        f"{duration(slowest[1].median)}. In order: {', '.join(name for name, _ in ordered)}."
    )
    close = [f"{a[0]} and {b[0]}" for a, b in pairwise(ordered) if b[1].low <= a[1].high]
    if close:
        text += f" The middle halves of {', of '.join(close)} overlap: this run does not tell them apart."
    return [
        text,
        "Each handshake is between two fresh processes with fresh static, pre-shared and ephemeral keys, each "
        "rekey between running ones with fresh ephemeral keys. The time is from before the initiation is made "
        "until the first frame comes out of the other daemon: the first part as measured in the core, the rest at "
        "the relay. The processes have started before; starting is about half a second of Python each and no part "
        "of the figures.",
    ]


def on_energy(findings: Findings) -> list[str]:
    """What the estimate is worth."""
    watts = findings.run.get("watts_per_core")
    boards = "; ".join(f"{each.name}: {each.watts_per_core:.2f} W ({each.source})" for each in BOARDS)
    texts = [
        f"Energy is an estimate: processor time of both daemons, measured on this machine, times {watts} W for a "
        "busy core (`--watts-per-core`). It holds for a machine whose own watts are given; for a slower board scale "
        "the processor time too, or measure there. What one busy core adds on typical boards, as others measured: "
        f"{boards}."
    ]
    joules = findings.spread("handshake", "joules")
    texts.append(
        f"The processor's own counters (RAPL), which count all that runs on it, say {joules.median:.3g} J while one "
        "handshake was measured."
        if joules
        else "This machine does not expose the processor's own energy counters (RAPL): no joules are measured."
    )
    return texts


def handshake_joules(findings: Findings, suite: str) -> float | None:
    """Estimated, of both daemons together."""
    return _joules(findings, "handshake", 1.0, suite=suite)


def frames_joules(findings: Findings, **point: Value) -> float | None:
    """Estimated, of both daemons together, for 1,000 frames."""
    records = [each for each in findings.of("frames", relay=False, **point) if each.is_ok]
    if not records:
        return None
    return _joules(findings, "frames", 1000.0 / records[0].number("sent"), relay=False, **point)


def _joules(findings: Findings, kind: str, factor: float, **point: Value) -> float | None:
    caller = findings.spread(kind, "cpu_caller_s", **point)
    answerer = findings.spread(kind, "cpu_answerer_s", **point)
    watts = findings.run.get("watts_per_core")
    if caller is None or answerer is None or not isinstance(watts, int | float):
        return None
    return factor * estimated_joules(caller.median + answerer.median, float(watts))


def with_spread(each: Spread) -> str:
    """A median with what stands around it."""
    if each.count == 1:
        return f"{duration(each.median)} (once)"
    if each.count < _ENOUGH_FOR_QUARTILES:
        return f"{duration(each.median)} (all {duration(each.least)} to {duration(each.most)}, n = {each.count})"
    return (
        f"{duration(each.median)} (middle half {duration(each.low)} to {duration(each.high)}, all "
        f"{duration(each.least)} to {duration(each.most)}, n = {each.count})"
    )


def _times(more: Spread, less: Spread, words: str = "less") -> str:
    if more.median < less.median:
        return f"{less.median / more.median:.1f} times more"
    ratio = more.median / less.median
    return f"{ratio:.0f} times {words}" if ratio >= 10 else f"{ratio:.1f} times {words}"


def _ratio(each: Spread) -> str:
    return f"{each.ratio:.0f}" if each.ratio >= 10 else f"{each.ratio:.1f}"


def not_finished(amount: int) -> str:
    """To be said behind a spread that has exchanges in it which were given up."""
    return f", {amount} not finished and counted as the limit" if amount else ""
