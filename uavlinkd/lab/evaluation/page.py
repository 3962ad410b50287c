"""A report in two formats: one self-contained HTML file, and Markdown with separate figures."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Generic, TypeVar

THE_PAPER = (
    "The paper: Ouadah and Merazka, Securing UAV Communication: Authentication and Integrity, 2024 "
    "(arXiv 2410.09085)."
)
"""Every report names it in full."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table with cells of text."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class ReportSection:
    """A heading, a figure and tables if there are any, and a caption of some paragraphs."""

    title: str
    figure: str = ""
    paragraphs: Sequence[str] = ()
    tables: Sequence[Table] = ()


F = TypeVar("F")


@dataclass(frozen=True, slots=True)
class ReportWriter(Generic[F]):
    """Writes the report of one evaluation from its records, ``name``.jsonl in the folder of a run."""

    name: str
    title: str
    read: Callable[[Path], F]
    """The records in a folder. It raises RecordsError without records, or if they cannot be read."""
    draw: Callable[[F], dict[str, bytes]]
    """The figures as SVG, by name."""
    make_sections: Callable[[F], list[ReportSection]]

    def has_records(self, folder: Path) -> bool:
        """Whether ``folder`` has records of this evaluation."""
        return (folder / f"{self.name}.jsonl").exists()

    def write(self, folder: Path) -> Path:
        """Draw the figures and write the report in HTML and Markdown. Return the path of the HTML."""
        findings = self.read(folder)
        figures = self._write_figures(findings, folder)
        sections = self.make_sections(findings)
        (folder / f"{self.name}.md").write_text(to_markdown(self.title, sections, figures), encoding="utf-8")
        html = folder / f"{self.name}.html"
        html.write_text(to_html(self.title, sections, figures), encoding="utf-8")
        return html

    def write_page(self, folder: Path, page: Path) -> Path:
        """Write the report as a Markdown page, with the figures in the folder ``results`` beside it."""
        findings = self.read(folder)
        results = page.parent / "results"
        results.mkdir(parents=True, exist_ok=True)
        figures = self._write_figures(findings, results)
        text = to_markdown(self.title, self.make_sections(findings), figures, "results/")
        page.write_text(text, encoding="utf-8")
        return page

    def _write_figures(self, findings: F, folder: Path) -> dict[str, bytes]:
        figures = self.draw(findings)
        for name, svg in figures.items():
            (folder / f"{name}.svg").write_bytes(svg)
        return figures


_CSS = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
p { max-width: 50rem; } img { max-width: 100%; height: auto; }
code { font-size: 0.9em; background: #f2f2f2; padding: 0 0.2em; }
table { border-collapse: collapse; font-size: 0.85rem; display: block; overflow-x: auto; margin: 1rem 0; }
th, td { border-bottom: 1px solid #ddd; padding: 0.25rem 0.6rem; text-align: left; vertical-align: top; }
@media (max-width: 45rem) {
  body { margin: 1rem auto; overflow-wrap: break-word; }
  .figure { overflow-x: auto; }
  .figure img { max-width: none; width: 44rem; }
  th, td { padding: 0.25rem 0.4rem; }
  table.wide, .wide tbody, .wide tr, .wide td { display: block; }
  .wide tr:first-child { display: none; }
  .wide tr { border-top: 2px solid #999; padding: 0.3rem 0; }
  .wide td { border: 0; display: grid; grid-template-columns: 42% 58%; padding: 0.1rem 0; }
  .wide td:first-child { display: block; font-weight: bold; }
  .wide td + td::before { content: attr(data-label); color: #555; }
}
"""
_NARROW_COLUMNS = 4
"""A phone has room for so many columns. A row of a wider table becomes a block of lines there."""


def _no_style(_text: str) -> str:
    return ""


def _marked_up(text: str) -> str:
    """The text in HTML, with code between backticks as in Markdown."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))


def to_html(
    title: str,
    sections: Sequence[ReportSection],
    figures: dict[str, bytes],
    to_style: Callable[[str], str] = _no_style,
) -> str:
    """The report as one self-contained file. ``figures`` are SVG by name; ``to_style`` returns the CSS of a cell."""
    parts = [
        '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">',
        f'<meta name="viewport" content="width=device-width">\n<title>{escape(title)}</title>',
        f"<style>{_CSS}</style>\n<h1>{escape(title)}</h1>",
    ]
    for section in sections:
        parts.append(f"<h2>{escape(section.title)}</h2>")
        if section.figure in figures:
            data = base64.b64encode(figures[section.figure]).decode("ascii")
            image = f'<img alt="{escape(section.title)}" src="data:image/svg+xml;base64,{data}">'
            parts.append(f'<div class="figure">{image}</div>')
        parts += [f"<p>{_marked_up(paragraph)}</p>" for paragraph in section.paragraphs]
        parts += [_html_table(table, to_style) for table in section.tables]
    return "\n".join([*parts, "</html>", ""])


def _html_table(table: Table, to_style: Callable[[str], str]) -> str:
    kind = ' class="wide"' if len(table.head) > _NARROW_COLUMNS else ""
    rows = ["".join(f"<th>{_marked_up(cell)}</th>" for cell in table.head)]
    for row in table.rows:
        cells = []
        for label, text in zip(table.head, row, strict=True):
            css = to_style(text)
            style = f' style="{css}"' if css else ""
            cells.append(f'<td data-label="{escape(label)}"{style}>{_marked_up(text)}</td>')
        rows.append("".join(cells))
    return f"<table{kind}>" + "\n".join(f"<tr>{row}</tr>" for row in rows) + "</table>"


def to_markdown(title: str, sections: Sequence[ReportSection], figures: dict[str, bytes], where: str = "") -> str:
    """The report as Markdown. ``where`` is the folder of the figures, relative to the page."""
    parts = [f"# {title}"]
    for section in sections:
        parts.append(f"## {section.title}")
        if section.figure in figures:
            parts.append(f"![{section.title}]({where}{section.figure}.svg)")
        parts += section.paragraphs
        for table in section.tables:
            lines = [table.head, ["---"] * len(table.head), *table.rows]
            parts.append("\n".join("| " + " | ".join(map(_safe, line)) + " |" for line in lines))
    return "\n\n".join(parts) + "\n"


def _safe(cell: str) -> str:
    return cell.replace("|", "\\|").replace("\n", " ")
