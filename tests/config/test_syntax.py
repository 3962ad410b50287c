"""Syntax errors have the line, the key and the remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

from uavlinkd.config.load import load_config
from uavlinkd.config.model import ConfigError

# The text of the file -> line, key and a part of the message.
_ERRORS = [
    ("name = drone0", 1, "name", 'write name = "drone0"; text is in straight quotation marks'),
    ('name = "drone0\nx = 1', 1, "name", 'write name = "drone0"'),
    ('name: "drone0"', 1, "name", "Expected '=' after a key in a key/value pair: write name = \"drone0\""),
    ('listen = ["0.0.0.0:5790"\nname = "a"', 2, "", "Unclosed array: close the brackets of the value above"),
    ('listen = [\n  "0.0.0.0:5790",\n\nname = "a"', 4, "", "close the brackets of the value above"),
    ('listen = [\n  "0.0.0.0:5790",\n  x\n]', 3, "", "Invalid value"),
    ("[link]\ntag_bits = 96\n// a comment", 3, "", "a comment begins with #"),
    ("confidential = True", 1, "confidential", "write confidential = true"),
    ("keepalive_s = 10s", 1, "keepalive_s", "write keepalive_s = 10"),
    ("[[peer]]\nname = 'a'\n\nname = 'b'", 4, "name", "[[peer]] or [[endpoint]] above"),
    ("[link]\n[link]", 2, "", "twice: write a key once"),
    ("[[peer]\n", 1, "", "Expected ']]'"),
    ("// a comment", 1, "", "a comment begins with #"),
]


def _problem(folder: Path, text: str) -> tuple[str, str, str]:
    path = folder / "drone0.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(path, {})
    (problem,) = caught.value.problems
    return problem.file.removeprefix(str(path)), problem.key, problem.message


@pytest.mark.parametrize(("text", "line", "key", "says"), _ERRORS, ids=[text for text, *_ in _ERRORS])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_error_is_at_its_line_and_key(tmp_path: Path, text: str, line: int, key: str, says: str, end: str) -> None:
    """With what to write, also with the line ends of a Windows editor."""
    place, named, message = _problem(tmp_path, f"{text}\n".replace("\n", end))
    assert (place.split(":")[1], named) == (str(line), key), message
    assert says in message


@pytest.mark.parametrize(
    "text",
    [
        *("[link.{}", "[log.{}]]", "[link.a\x1b]0;{}\x07", "[peer.{}", "[link.{}]\n[link.{}]", "[peer.{}] x"),
        *("[link] {}", "[peer {}]", "[{}", "{}", "{} = 1\n{} = 2", "private_key = {}", "a = '{}", 'a = ["{}"\nb = 1'),
        *("[a]\n{} = 1\n[a.{}]", "a = {{ {} = 1, {} = 2 }}", "name.{} = 1\nname.{} = 2", "{}: 1", "; {}", "a = 1 {}"),
    ],
)
def test_no_message_repeats_what_may_be_a_key(tmp_path: Path, text: str) -> None:
    """Wherever it stands, also behind the dot of a section's name; no character controls a terminal."""
    key = "wJ9m3cYf0Q7m2bqkq3v1nq0F2s6gYp8Q5l0kq9Zs0Xk"
    _, named, message = _problem(tmp_path, text.replace("{}", key).replace("{{", "{").replace("}}", "}"))
    assert key[:8] not in named + message
    assert message.isprintable()
