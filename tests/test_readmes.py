"""The README files: their length, their links, and the names of events and reasons in them."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.protocol.drops import DropReason

ROOT = Path(__file__).parents[1]
PAGES = [
    *ROOT.glob("*.md"),
    *(
        page
        for folder in (".github", "configs", "systemd", "tests", "uavlinkd")
        for page in (ROOT / folder).rglob("*.md")
    ),
]
MAX_WORDS = 1300
_LINK = re.compile(r"(?<!!)\[[^\]]*(?:\[\[[^\]]*\]\])?[^\]]*\]\(([^)\s]+)\)")
_FENCE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
_NAME = re.compile(r"`([a-z][a-z0-9]*(?:_[a-z0-9]+)+)`")


@cache
def anchors(page: Path) -> frozenset[str]:
    """The fragments that a page's headings make, by GitHub's rule."""
    titles = re.findall(r"^#+ (.+)$", _FENCE.sub("", page.read_text()), re.MULTILINE)
    return frozenset(re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles)


def names_in_table(page: Path, heading: str) -> set[str]:
    """The names with an underscore in the first column of the table below a heading."""
    section = page.read_text().split(f"\n## {heading}\n")[1].split("\n## ")[0]
    return {
        name for line in section.splitlines() if line.startswith("|") for name in _NAME.findall(line.split(" | ")[0])
    }


def test_readme_is_short() -> None:
    """Details belong beside what they describe."""
    assert len((ROOT / "README.md").read_text().split()) <= MAX_WORDS


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    """Each relative link names a file or folder, and its fragment a heading there."""
    broken = []
    for link in _LINK.findall(_FENCE.sub("", page.read_text())):
        path, _, fragment = link.partition("#")
        if re.match(r"[a-z]+:", path):
            continue
        target = page.parent / path if path else page
        if not target.exists() or (fragment and fragment not in anchors(target)):
            broken.append(link)
    assert broken == []


@pytest.mark.parametrize(
    ("page", "heading"),
    [
        ("uavlinkd/ops/README.md", "Logs"),
        ("uavlinkd/ops/README.md", "Symptoms"),
    ],
)
def test_events_and_reasons_exist(page: str, heading: str) -> None:
    """A renamed log event or reason is renamed in the tables that explain it."""
    code = "".join(path.read_text() for path in (ROOT / "uavlinkd").rglob("*.py"))
    reasons = {reason.value for reason in (*DropReason, *Refusal)}
    names = names_in_table(ROOT / page, heading)
    assert names
    assert {name for name in names - reasons if not re.search(f'"{name}"|def _{name}\\(', code)} == set()
