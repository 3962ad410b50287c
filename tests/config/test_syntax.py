"""Syntax errors name the likely slip, with its line, key and remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

from uavlinkd.config import ConfigError, keys
from uavlinkd.config.load import load_config

# The text of the file -> line, key and a part of the message.
_SLIPS = [
    ("name = drone0", 1, "name", 'without quotation marks: write name = "drone0"'),
    ('name = "drone0\nx = 1', 1, "name", 'no closing quotation mark: write name = "drone0"'),
    ('name = drone0"', 1, "name", 'no opening quotation mark: write name = "drone0"'),
    ("name = 'drone0\"", 1, "name", "two kinds of quotation marks"),
    ('name = """drone0', 1, "name", "is not closed"),
    ("name = “drone0”", 1, "name", "typographic quotation marks"),
    ('name =\u00a0"drone0"', 1, "name", "a space of another kind"),
    ('name: "drone0"', 1, "name", 'a colon where TOML has =: write name = "drone0"'),
    ('name := "drone0"', 1, "name", "a colon where TOML has ="),
    ('name == "drone0"', 1, "name", "== in place of ="),
    ('name "drone0"', 1, "name", 'no = after the key: write name = "drone0"'),
    ("name", 1, "name", "no = after the key"),
    ("name =", 1, "name", "has no value"),
    ("listen = 0.0.0.0:5790", 1, "listen", 'write listen = ["0.0.0.0:5790"]'),
    ("listen = [0.0.0.0:5790]", 1, "listen", 'write listen = ["0.0.0.0:5790"]'),
    ('listen = ["0.0.0.0:5790"\nname = "a"', 1, "listen", 'without its closing bracket: write listen = ["0.0'),
    ('listen = [\n  "0.0.0.0:5790",\n\nname = "a"', 1, "listen", "without its closing bracket"),
    ("[[peer]]\nsystem_ids = [1, 2\n[[peer]]", 2, "system_ids", "closing bracket: write system_ids = [2]"),
    ('listen = "0.0.0.0:5790"]', 1, "listen", "without its opening bracket"),
    ("system_ids = [1-10]", 1, "system_ids", 'such as "1-10"'),
    ("system_ids = [01]", 1, "system_ids", "begins with 0"),
    ('suites = ["a" "b"]', 1, "suites", "without a comma between them"),
    ("role = swarm-member", 1, "role", 'write role = "swarm-member"'),
    ("rate_in = { ATTITUDE = 10", 1, "rate_in", "no closing brace"),
    ("rate_in = { ATTITUDE: 10 }", 1, "rate_in", "colon in its table"),
    ("confidential = True", 1, "confidential", "write confidential = true"),
    ("confidential = yes # really", 1, "confidential", "write confidential = true"),
    ("radio_status = Off", 1, "radio_status", "write radio_status = false"),
    ('control_socket = "C:\\Users"', 1, "control_socket", "a backslash in its text"),
    ("keepalive_s = 10s", 1, "keepalive_s", "a unit after its number"),
    ("max_age_s = 1,5", 1, "max_age_s", "a decimal comma"),
    ("name = 'a';", 1, "name", "comma or semicolon"),
    ("name = 'a' listen = []", 1, "name", "two keys in one line"),
    ("name = 'a' really", 1, "name", "begin a comment with #"),
    ("name = 'a'\nname = 'b'", 2, "name", "first in line 1"),
    ("[[peer]]\nname = 'a'\n\nname = 'b'", 4, "name", "write [[peer]] or [[endpoint]] above"),
    ("[link]\n[link]", 2, "", "a second [link]: write its keys below the first, in line 1"),
    ("[peer]\nname = 'a'\n[peer]\nname = 'b'", 1, "", "write [[peer]], in double brackets"),
    ("[[peer]]\nname = 'a'\n[peer]\nname = 'b'", 3, "", "write [[peer]], in double brackets"),
    ("[peer]\nname = 'a'\n[[peer]]\nname = 'b'", 1, "", "write [[peer]], in double brackets"),
    ("[[peer]\n", 1, "", "brackets that do not match: write [[peer]]"),
    ("[endpoint\n", 1, "", "brackets that do not match: write [[endpoint]]"),
    ("[log]]\n", 1, "", "brackets that do not match: write [log]"),
    ("[log] level\n", 1, "", "on a line of its own"),
    ("; a comment", 1, "", "a comment begins with #"),
    ("// a comment", 1, "", "a comment begins with #"),
    ("- name: a", 1, "", "as in YAML"),
]


def _problem(folder: Path, text: str) -> tuple[str, str, str]:
    path = folder / "drone0.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(path, {})
    (problem,) = caught.value.problems
    return problem.file.removeprefix(str(path)), problem.key, problem.message


@pytest.mark.parametrize(("text", "line", "key", "says"), _SLIPS, ids=[text for text, *_ in _SLIPS])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_slip_is_named(tmp_path: Path, text: str, line: int, key: str, says: str, end: str) -> None:
    """Also with the line ends of a Windows editor."""
    place, named, message = _problem(tmp_path, f"{text}\n".replace("\n", end))
    assert (place.split(":")[1], named) == (str(line), key), message
    assert says in message


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[Interface]\nPrivateKey = {key}\n[Peer]\nPublicKey = {key}\n", "is a WireGuard file"),
        ("[Peer]\nPublicKey = {key}\nAllowedIPs = 10.0.0.2/32\n", "is a WireGuard file"),
        ("[General]\n[UdpEndpoint uavlinkd]\nMode = Normal\n", "is a file of mavlink-router"),
        ('{"name": "drone0"}', "is JSON"),
        ("{key}\n", "is a key file"),
    ],
)
def test_file_of_another_kind_is_named(tmp_path: Path, text: str, says: str) -> None:
    """With what to do. The keys in it are not repeated."""
    key = keys.generate_private_key()
    place, _, message = _problem(tmp_path, text.replace("{key}", key))
    assert place == ""
    assert says in message
    assert key[:8] not in message


@pytest.mark.parametrize(
    "text", ["\x00", '"a = 1', "a = 1\n\x07", "[" * 5000, "=" * 5000, "[a]\n" * 2, "\n" * 9 + "]"]
)
def test_other_errors_keep_the_parsers_reason(tmp_path: Path, text: str) -> None:
    """No rule matches: the message has the place and the parser's own words."""
    _, _, message = _problem(tmp_path, text)
    assert "TOML" in message or "brackets" in message


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
