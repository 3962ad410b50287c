"""Words that the project does not write, and what it writes instead.

Readers from many countries, often under stress, need short sentences with a subject and the field's own nouns. The
words of this table do not help them. They are searched in comments, docstrings, strings, names and Markdown.

``python -m tests.plain_english [folder or file …]`` lists each use with its file and line.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).parents[1]

_FLOW = "(?:frames?|records?|datagrams?|envelopes?|messages?)"
_ONE = "(?:(?:an?|the|each|its|their|every|no|one|all|any|this|that|these|those|our) )?"
_PEER = "(?:an? |the |its |each |that |every )?(?:peer|vehicle|drone|station|responder)s?"
_COMPARED = (
    "(?:longer|more|less|later|earlier|fewer|better|worse|larger|smaller|weaker|stronger|shorter|slower|faster)"
)
_PLACE = "(?:in|at|there|here|beside|on|under|above|below)"

WORDS: Mapping[str, str] = {
    "told": "reported, logged, notified, counted",
    "tells of": "reports, logs",
    r"(?-i:Who)(?![^.\n]*\?)": "a sender, client or attacker that …",
    "(?:for|from|to|by|of|with|against|as|than|but|and|or) who": "a sender, client or attacker that …",
    "whoever": "a sender, client or attacker that …",
    "nobody|anybody|somebody": "no client, any sender, a peer",
    "heard": "received, last seen",
    "unheard": "silent",
    "lately": "recently",
    "programs?": "client",
    "callers?": "initiator",
    f"(?:calls|called|calling|call) {_PEER}": "initiates, connects to",
    "goodbyes?": "close",
    "in doubt": "freshness unverified",
    "left behind": "superseded",
    "rested|resting|(?:index|indices|it|they|that|which) rests?": "is quarantined",
    "for ever|forever": "indefinitely",
    "amounts?": "count",
    "chances?": "rng, random source, at random",
    "(?:is|are|was|were|be) (?-i:none)": "is not a …",
    rf"(?<!there[\s_])(?:is|are|was|were) no (?!{_COMPARED})[a-z]+": "is not a …",
    f"(?:give|gives|gave|giving|take|takes|took|taking) {_ONE}{_FLOW}": "send, deliver, pop, consume",
    "troubles?": "problem",
    "disturbances?": "link error",
    "(?:comes|came|becomes|became|become) of (?:it|them|that|this|each|an?|the)": "result",
    "no good|(?:keys?|PSKs?|pairs?|it|one|both) (?:is|are|was|were) (?:still )?good": "valid; revoked, expired",
    f"(?:stands?|stood) {_PLACE}": "is, is written",
    "on (?:its|the|their) way|each way|both ways|either way": "route, direction, path",
    "anew": "again",
    "hence|thus|thereby|thereof|wherein|whence|thence": "so, therefore",
}
"""What is not written (a pattern, in upper or lower case), and what is written instead."""

NAMES = frozenset({"each", "found"})
"""Not the name of a variable or parameter: it says nothing about the value."""


@dataclass(frozen=True, slots=True)
class Allowed:
    """A text that may be written although a word of the table is in it."""

    text: str
    files: str
    """A pattern of the files in which it may."""
    reason: str


ALLOWED = (
    Allowed("`troubles`", "CHANGELOG.md", "a key of the statistics that was renamed"),
    Allowed("`cpu_caller_s`", "CHANGELOG.md", "a value in records that was renamed"),
    Allowed("`gcs_heard`", "CHANGELOG.md", "an event of the simulator that was renamed"),
    Allowed("program_found", "RESULTS-tampering.md", "a log event in the records of a run"),
    Allowed("`program_found`, `program_gone`", "CHANGELOG.md", "log events that were renamed"),
    Allowed("`program`, `programs`", "CHANGELOG.md", "log fields that were renamed"),
    Allowed("`heard_s`", "CHANGELOG.md", "a key of the status document that was renamed"),
    Allowed("--reuid=nobody", "tests/compose/test_systemd.py", "an account of every Linux"),
    Allowed("`uavlinkd_endpoint_programs`", "CHANGELOG.md", "a metric that was renamed"),
    Allowed("`uavlinkd_peer_last_heard_age_seconds`", "CHANGELOG.md", "a metric that was renamed"),
    Allowed("key of an endpoint in the JSON of `status` | `programs`", "CHANGELOG.md", "a key that was renamed"),
)


@dataclass(frozen=True, slots=True)
class Use:
    """One place where a word of the table is written."""

    file: PurePosixPath
    line: int
    word: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.word}"


# Between two words may be the end of a line, with the mark of a comment.
_PATTERN = re.compile(
    r"(?i)(?<![a-z])(?:" + "|".join(words.replace(" ", r"[\s_#*]+") for words in WORDS) + r")(?![a-z])"
)
_SUFFIXES = frozenset({".py", ".md", ".toml", ".service", ".yml", ".yaml", ".pv", ".pvl", ".c", ".sh", ".txt", ""})
_PLACES = ("*.md", "*.toml", ".ci", "configs", "systemd", "tests", "uavlinkd")
_NOT_TEXT = ("tests/fuzz/corpus/*", "tests/plain_english.py", "tests/test_quality.py")


def files() -> Iterator[PurePosixPath]:
    """Every text of the project, relative to its root."""
    for place in _PLACES:
        for top in ROOT.glob(place):
            for path in [top, *top.rglob("*")]:
                file = PurePosixPath(path.relative_to(ROOT))
                if path.is_file() and path.suffix in _SUFFIXES and not any(map(file.match, _NOT_TEXT)):
                    yield file


def uses(text: str, file: PurePosixPath, exceptions: Sequence[Allowed] = ALLOWED) -> list[Use]:
    """Each word of the table in ``text``, which is the content of ``file``."""
    readable = text
    for allowed in exceptions:
        if file.match(allowed.files):
            readable = readable.replace(allowed.text, " " * len(allowed.text))
    result = [
        Use(file, readable.count("\n", 0, match.start()) + 1, " ".join(match[0].split()))
        for match in _PATTERN.finditer(readable)
    ]
    if file.suffix == ".py":
        result += [Use(file, line, name) for line, name in _variables(text) if name in NAMES]
    return sorted(result, key=lambda use: use.line)


def _variables(source: str) -> Iterator[tuple[int, str]]:
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.arg(arg=name):
                yield node.lineno, name


def all_uses() -> Iterator[Use]:
    """Every use in the project's texts."""
    for file in files():
        yield from uses((ROOT / file).read_text(errors="replace"), file)


def main() -> None:
    """List the uses in the folders and files of the command line, or everywhere."""
    wanted = [PurePosixPath(argument) for argument in sys.argv[1:]] or [PurePosixPath(".")]
    listed = [use for use in all_uses() if any(place in (use.file, *use.file.parents) for place in wanted)]
    print(*listed, f"{len(listed)} uses", sep="\n")


if __name__ == "__main__":
    main()
