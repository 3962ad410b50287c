"""Write the man page and the shell completions of each command below a folder, such as /usr/local.

``python3 systemd/deb/manuals.py DIR``, with the Python that has uavlinkd and its extra ``completion``. Both come from
the parser of the command line. Without the laboratory, its commands have no arguments, and `uavlink-mitm` no page.
"""

from __future__ import annotations

import argparse
import gzip
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import shtab

from uavlinkd import __version__, cli
from uavlinkd.system.terminal import CommandError

MEMBERS = "uavlinkd fleet list 2>/dev/null | tail -n +3 | cut -d ' ' -f 1"
"""Prints the members of the fleet in the present folder, when Tab is pressed."""
STATIONS = (
    "find . /etc/uavlinkd -maxdepth 1 -name '*.toml' -exec"
    """ awk -F'"' '/^[[]/ { here = /station[]][]]/ } here && /^name/ { print $2 }' '{}' + 2>/dev/null"""
)
"""Prints the stations of the configurations there and of the services."""
NAMES = {
    "uavlinkd fleet sign": ("members", MEMBERS),
    "uavlinkd fleet remove": ("members", MEMBERS),
    "uavlinkd station remove": ("stations", STATIONS),
}
"""Commands whose NAME is completed: with the names that a shell command prints."""


def main() -> None:
    """Write all files."""
    options = argparse.ArgumentParser(description="Write man pages and shell completions.")
    options.add_argument("folder", metavar="DIR", type=Path, help="/usr/local, or ~/.local")
    prefix = options.parse_args().folder
    zsh = "vendor-completions" if prefix.name == "usr" else "site-functions"
    for parser in parsers():
        name = parser.prog
        complete_arguments(parser)
        files = {
            f"man/man1/{name}.1.gz": gzip.compress("\n".join(man_page(parser)).encode(), mtime=0),
            f"bash-completion/completions/{name}": shtab.complete(parser, "bash").encode(),
            f"zsh/{zsh}/_{name}": shtab.complete(parser, "zsh").encode(),
            f"fish/vendor_completions.d/{name}.fish": shtab.complete(parser, "fish").encode(),
        }
        for path, content in files.items():
            file = prefix / "share" / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)


def parsers() -> Iterator[argparse.ArgumentParser]:
    """The parser of each console script, with those of all its commands."""
    uavlinkd = cli.make_parser()
    has_laboratory = True
    for commands in subparsers(uavlinkd):
        for command in commands.choices.values():
            try:
                command.fill()  # type: ignore[attr-defined]
            except CommandError:
                has_laboratory = False
    yield uavlinkd
    if not has_laboratory:
        return
    from uavlinkd.lab.mitm import cli as mitm_cli  # noqa: PLC0415  the Debian package has no laboratory

    yield mitm_cli.make_parser()


def subparsers(parser: argparse.ArgumentParser) -> Iterator[argparse._SubParsersAction[argparse.ArgumentParser]]:
    """The commands of a parser: none or one."""
    yield from (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))


def names(kind: str, command: str) -> dict[str, Any]:
    """How each shell completes names that a command prints."""
    function = f"_uavlinkd_{kind}"
    return {
        "bash": function,
        "zsh": function,
        "fish": f"({function})",
        "preamble": {
            "bash": f'{function}() {{ compgen -W "$({command})" -- "$1"; }}',
            "zsh": f'{function}() {{ compadd -- ${{(f)"$({command})"}} }}',
            "fish": f"function {function}; {command}; end",
        },
    }


def complete_arguments(parser: argparse.ArgumentParser) -> None:
    """Complete files and folders where an argument is a path, and names of members and stations."""
    for action in parser._actions:
        if action.metavar == "NAME" and parser.prog in NAMES:
            action.complete = names(*NAMES[parser.prog])  # type: ignore[attr-defined]
        if action.type is Path:
            action.complete = shtab.DIRECTORY if action.metavar == "DIR" else shtab.FILE  # type: ignore[attr-defined]
    for commands in subparsers(parser):
        for command in commands.choices.values():
            complete_arguments(command)


# Man pages.


def man_page(parser: argparse.ArgumentParser) -> Iterator[str]:
    """The lines of a page."""
    yield f'.TH {roff(parser.prog.upper())} 1 "" "uavlinkd {__version__}" "User Commands"'
    yield from (".SH NAME", rf"{roff(parser.prog)} \- {roff(str(parser.description).partition('. ')[0])}")
    yield ".SH SYNOPSIS"
    yield from command_lines(parser)


def command_lines(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Usage, description and arguments of a parser, and then those of its commands."""
    formatter = parser._get_formatter()
    usage = " ".join(parser.format_usage().removeprefix("usage: ").split())
    yield from (roff(usage), ".PP", roff(str(parser.description)))
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for choice in action._choices_actions:
                yield from (".TP", rf"\fB{roff(choice.dest)}\fR", roff(choice.help or ""))
        elif action.dest != "help":
            yield from (".TP", rf"\fB{roff(formatter._format_action_invocation(action))}\fR")
            yield roff(formatter._expand_help(action) if action.help else "")
    if parser.epilog:
        yield from (".PP", roff(parser.epilog))
    for commands in subparsers(parser):
        for command in commands.choices.values():
            yield f".SH {roff(command.prog)}"
            yield from command_lines(command)


def roff(text: str) -> str:
    """A text in which groff sees no request and no escape sequence."""
    return r"\&" + text.replace("\\", r"\e").replace("-", r"\-").replace('"', r"\(dq")


if __name__ == "__main__":
    main()
