"""The report: self-contained, from records alone, with everything that failed."""

from __future__ import annotations

import os
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest

if not os.environ.get("CI"):  # there it must be
    pytest.importorskip("matplotlib", reason="the figures need matplotlib")

from tests.lab.evaluation.samples import FAILED, RUN, a_run
from uavlinkd.lab.evaluation.records import RecordsError, RecordWriter
from uavlinkd.lab.evaluation.report import write_page, write_report


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with records only."""
    with RecordWriter(tmp_path, "timing", RUN) as writer:
        for record in a_run(FAILED).records:
            writer.add(record)
    return tmp_path


def test_the_report_needs_no_other_file(folder: Path) -> None:
    """It contains every figure and loads no other file."""
    html = write_report(folder).read_text(encoding="utf-8")
    sources = re.findall(r'(?:src|href)="([^"]{0,30})', html)
    assert len(sources) == 5
    assert all(source.startswith("data:image/svg+xml;base64,") for source in sources)


def test_the_report_names_the_paper(folder: Path) -> None:
    """Its readers may not know it."""
    assert "Ouadah and Merazka, Securing UAV Communication" in write_report(folder).read_text(encoding="utf-8")


def test_code_in_a_paragraph_has_no_backticks_in_html(folder: Path) -> None:
    """They are the mark of Markdown."""
    html = write_report(folder).read_text(encoding="utf-8")
    assert "<code>--watts-per-core</code>" in html
    assert "`" not in html
    assert "`--watts-per-core`" in (folder / "report.md").read_text(encoding="utf-8")


def test_wide_tables_become_lists_on_a_phone(folder: Path) -> None:
    """A phone shows four columns. In a wider table each cell has the name of its column, which CSS shows there."""
    html = write_report(folder).read_text(encoding="utf-8")
    assert '<meta name="viewport" content="width=device-width">' in html
    assert html.count('<div class="figure"><img ') == html.count("<img "), "a figure keeps its size, and scrolls"
    for kind, head, rows in re.findall(r"<table( class=\"wide\")?><tr>(.*?)</tr>(.*?)</table>", html, re.DOTALL):
        columns = re.findall(r"<th>(.*?)</th>", head)
        assert bool(kind) == (len(columns) > 4)
        for row in re.findall(r"<tr>(.*?)</tr>", rows):
            assert re.findall(r'<td data-label="(.*?)"', row) == columns


def test_a_failed_point_is_in_the_report_with_its_reason_as_text(folder: Path) -> None:
    """The reason is escaped: it may contain text of a daemon."""
    html = write_report(folder).read_text(encoding="utf-8")
    assert "no session &lt;within&gt; 20 s" in html
    assert "<within>" not in html
    assert "1 measurements failed" in html


def test_the_tags_of_the_report_are_balanced(folder: Path) -> None:
    """A browser does not have to guess."""

    class Checker(HTMLParser):
        open_tags: list[str] = []  # noqa: RUF012  one instance

        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            if tag not in ("meta", "img"):
                self.open_tags.append(tag)

        def handle_endtag(self, tag: str) -> None:
            assert self.open_tags.pop() == tag

    checker = Checker()
    checker.feed(write_report(folder).read_text(encoding="utf-8"))
    assert checker.open_tags == []


def test_the_report_is_drawn_again_from_the_records_alone(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """The records in another folder give the same report, byte for byte."""
    first = write_report(folder).read_bytes()
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    shutil.copy(folder / "timing.jsonl", elsewhere)
    assert write_report(elsewhere).read_bytes() == first
    assert (elsewhere / "report.md").read_bytes() == (folder / "report.md").read_bytes()


def test_the_markdown_names_the_figures_that_are_beside_it(folder: Path) -> None:
    """And its tables have one width each."""
    write_report(folder)
    text = (folder / "report.md").read_text(encoding="utf-8")
    for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", text):
        assert (folder / name).is_file()
    for block in re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE):
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}) == 1


def test_a_page_has_its_figures_in_a_folder_beside_it(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Every link has a target; the rest equals the report."""
    page = write_page(folder, tmp_path_factory.mktemp("docs") / "RESULTS.md")
    write_report(folder)
    text = page.read_text(encoding="utf-8")
    links = re.findall(r"!\[[^]]*\]\(([^)]+)\)", text)
    assert len(links) == 5
    assert all((page.parent / link).is_file() for link in links)
    assert text.replace("(results/", "(") == (folder / "report.md").read_text(encoding="utf-8")


def test_the_equal_size_table_refuses_small_groups_and_shows_the_factor(folder: Path) -> None:
    """512 bits exist for the paper's method alone; 2048 for both; 4096 did not finish."""
    write_report(folder)
    lines = (folder / "report.md").read_text(encoding="utf-8").splitlines()
    rows = {line.split("|")[1].strip(): line for line in lines if line.startswith("| ") and line[2].isdigit()}
    assert "refused: too small" in rows["512"]
    assert rows["2048"].rstrip("| ").endswith("2105")
    assert "not finished: not finished in 600 s (1)" in rows["4096"]


def test_an_interrupted_run_gives_a_report_that_says_so(tmp_path: Path) -> None:
    """Facts alone, no record."""
    with RecordWriter(tmp_path, "timing", RUN):
        pass
    assert "was interrupted" in write_report(tmp_path).read_text(encoding="utf-8")


def test_a_folder_without_records_is_an_error(tmp_path: Path) -> None:
    """For the command to print."""
    with pytest.raises(RecordsError):
        write_report(tmp_path)
