"""A report in two forms of the same: one HTML file that needs no other, and Markdown beside its figures."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from html import escape


@dataclass(frozen=True, slots=True)
class Table:
    """Cells as text."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Section:
    """A heading, a figure where there is one, paragraphs, a table where there is one."""

    title: str
    figure: str = ""
    paragraphs: Sequence[str] = field(default_factory=list)
    table: Table | None = None


_CSS = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
p { max-width: 50rem; } img { max-width: 100%; height: auto; }
table { border-collapse: collapse; font-size: 0.85rem; display: block; overflow-x: auto; }
th, td { border-bottom: 1px solid #ddd; padding: 0.25rem 0.6rem; text-align: left; vertical-align: top; }
"""


def _plain_cell(text: str) -> str:
    return f"<td>{escape(text)}</td>"


def to_html(
    title: str,
    sections: Sequence[Section],
    figures: dict[str, bytes],
    to_cell: Callable[[str], str] = _plain_cell,
) -> str:
    """One file that needs no other. ``figures`` are SVG by name; ``to_cell`` makes a table's cell of its text."""
    parts = [
        f'<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>{escape(title)}</title>',
        f"<style>{_CSS}</style>\n<h1>{escape(title)}</h1>",
    ]
    for section in sections:
        parts.append(f"<h2>{escape(section.title)}</h2>")
        if section.figure in figures:
            data = base64.b64encode(figures[section.figure]).decode("ascii")
            parts.append(f'<img alt="{escape(section.title)}" src="data:image/svg+xml;base64,{data}">')
        parts += [f"<p>{escape(paragraph)}</p>" for paragraph in section.paragraphs]
        if section.table is not None:
            head = "".join(f"<th>{escape(cell)}</th>" for cell in section.table.head)
            rows = ["".join(map(to_cell, row)) for row in section.table.rows]
            parts.append(f"<table><tr>{head}</tr>\n" + "\n".join(f"<tr>{row}</tr>" for row in rows) + "</table>")
    return "\n".join([*parts, "</html>", ""])


def to_markdown(title: str, sections: Sequence[Section], figures: dict[str, bytes], where: str = "") -> str:
    """For a page in a repository; ``where`` is the folder of the figures, seen from there."""
    parts = [f"# {title}"]
    for section in sections:
        parts.append(f"## {section.title}")
        if section.figure in figures:
            parts.append(f"![{section.title}]({where}{section.figure}.svg)")
        parts += section.paragraphs
        if section.table is not None:
            lines = [section.table.head, ["---"] * len(section.table.head), *section.table.rows]
            parts.append("\n".join("| " + " | ".join(map(_safe, line)) + " |" for line in lines))
    return "\n\n".join(parts) + "\n"


def _safe(cell: str) -> str:
    return cell.replace("|", "\\|").replace("\n", " ")
