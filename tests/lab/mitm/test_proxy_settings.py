"""The configuration of the man in the middle: all problems at once; options override the file."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from uavlinkd.lab.mitm.attack import Direction
from uavlinkd.lab.mitm.proxy_settings import (
    ProxySettings,
    SettingsError,
    load_proxy_settings,
    overridden,
    parse_link,
    parse_peer,
    parse_radio,
)
from uavlinkd.lab.mitm.radio import Bursts, Outage
from uavlinkd.system.addresses import Address

EXAMPLE = Path(__file__).parents[3] / "configs" / "mitm.toml"
KEY = "Ya1BcyCMNCoxhVU/dI5z9wlfOD9PHricYw/gaSC3swU="
GOOD = """
[[peer]]
name = "a"
address = "127.0.0.1:1"
[[peer]]
name = "b"
[[link]]
between = ["a", "b"]
listen = ["127.0.0.1:3", "127.0.0.1:4"]
"""


def _load(folder: Path, text: str) -> ProxySettings:
    path = folder / "mitm.toml"
    path.write_text(text)
    return load_proxy_settings(path)


def test_example_is_good() -> None:
    """configs/mitm.toml loads; its files are beside it; both keys are known."""
    settings = load_proxy_settings(EXAMPLE)
    assert [attack.name for attack in settings.attacks] == ["replay-data", "tamper-key"]
    assert settings.log == EXAMPLE.parent / "mitm.jsonl"
    assert settings.context.directions == (Direction("drone0", "drone1"), Direction("drone1", "drone0"))
    assert set(settings.context.public_keys) == {"drone0", "drone1"}
    assert settings.radio_of()[Direction("drone1", "drone0")].bursts == Bursts(0.005, 0.25)


def test_least_file_is_a_cable(tmp_path: Path) -> None:
    """Two peers and a link; no attack, no radio, no log."""
    settings = _load(tmp_path, GOOD)
    assert (settings.attacks, settings.radios, settings.log, settings.seed) == ((), (), None, 0)
    assert settings.peers[1].address is None


def test_a_second_link_of_a_pair_is_a_second_path(tmp_path: Path) -> None:
    """Its radio and its attacks name it by its number, whichever peer comes first."""
    second = '[[link]]\nbetween = ["b", "a"]\nlisten = ["127.0.0.1:5", "127.0.0.1:6"]\n'
    more = (
        '[[radio]]\ndirection = "both/2"\ndelay_s = 0.1\n[[attack]]\nname = "move"\ndirection = "both/1"\nonto = 2\n'
    )
    settings = _load(tmp_path, GOOD + second + more)
    assert settings.listeners == {
        Direction("a", "b"): Address("127.0.0.1", 3),
        Direction("b", "a"): Address("127.0.0.1", 4),
        Direction("b", "a", 2): Address("127.0.0.1", 5),
        Direction("a", "b", 2): Address("127.0.0.1", 6),
    }
    assert {str(direction) for direction in settings.radio_of()} == {"a>b/2", "b>a/2"}


@pytest.mark.parametrize(
    ("text", "problems"),
    [
        (GOOD + '[[attack]]\nname = "move"', ["attack move: there is no path 2"]),
        (GOOD + '[[radio]]\ndirection = "both/2"', ["radio: direction must be both"]),
        ("", ["peer: at least two peers are required", "link: at least one link is required"]),
        ("a = b", ["is not valid TOML"]),
        (GOOD + "x = 1", ["link[0].x: is an unknown key"]),
        (GOOD.replace('"b"]', '"c"]'), ["link[0].between: must name two of the peers, which are a, b"]),
        (GOOD + '[[peer]]\nname = "b"', ["peer: two peers have the same name"]),
        (GOOD.replace(":4", ":3"), ["link: a listen address is used twice"]),
        (GOOD.replace("127.0.0.1:1", "0.0.0.0:1"), ["peer[0].address: is a wildcard address"]),
        (GOOD.replace("127.0.0.1:3", "here:3"), ["link[0].listen[0]: must be a numeric address"]),
        (GOOD.replace('name = "b"', 'name = "b b"'), ["peer[1].name: must be letters"]),
        (GOOD.replace('name = "b"', 'name = "both"'), ["peer[1].name: is reserved for both directions"]),
        (GOOD + '[[attack]]\nname = "droop"', ["attack[0]: there is no such attack: did you mean drop?"]),
        (
            GOOD + '[[attack]]\nname = "drop"\ndirection = "a>c"',
            ["attack drop: direction must be both or one of a>b, b>a"],
        ),
        (GOOD + '[[attack]]\nname = "misroute"', ["attack misroute: misroute needs at least three peers"]),
        (GOOD + "[[radio]]\nloss = 2.0", ["radio[0]: loss must be a share from 0 to 1"]),
        (GOOD + '[[radio]]\ndirection = "b>c"', ["radio: direction must be both"]),
        (
            GOOD + '[[radio]]\nloss = "x"\n[[radio]]\njitter = 1',
            ["radio[0].loss: ", "radio[1].jitter: is an unknown key"],
        ),
        (GOOD.replace('"b"\n[', '"b"\npublic_key = "AAAA"\n['), ["peer[1].public_key: must be 44 characters"]),
        ("log_detail = -1\nseed = 'x'" + GOOD, ["log_detail: ", "seed: "]),
    ],
)
def test_every_problem_is_reported_with_its_place(tmp_path: Path, text: str, problems: list[str]) -> None:
    """File, key and what to write; all of them together."""
    with pytest.raises(SettingsError) as caught:
        _load(tmp_path, text)
    assert len(caught.value.problems) == len(problems), caught.value
    for problem, expected in zip(sorted(caught.value.problems), sorted(problems), strict=True):
        assert f"mitm.toml: {expected}" in problem


def test_missing_file_is_reported(tmp_path: Path) -> None:
    """One line, with the reason."""
    with pytest.raises(SettingsError, match="cannot be read: No such file"):
        load_proxy_settings(tmp_path / "none.toml")


def test_flags_are_read() -> None:
    """Peers with and without a key, links, radios."""
    assert parse_peer("a=127.0.0.1:5").address == Address("127.0.0.1", 5)
    assert parse_peer(f"a=127.0.0.1:5,{KEY}").public_key is not None
    link = parse_link("a@127.0.0.1:5,b@[::1]:6")
    assert (link.peers, link.listen) == (("a", "b"), (Address("127.0.0.1", 5), Address("::1", 6)))
    direction, radio = parse_radio(
        "direction=a>b,loss=0.1,keeps_order=true,outage_at_s=5,outage_s=2,outage_every_s=10,bits_per_s=64000"
    )
    assert direction == "a>b"
    assert (radio.loss, radio.keeps_order, radio.bits_per_s) == (0.1, True, 64000)
    assert radio.outages == (Outage(5, 7, 10),)


@pytest.mark.parametrize(
    ("parse", "text", "message"),
    [
        (parse_peer, "a", "port"),
        (parse_peer, "=127.0.0.1:5", "letters"),
        (parse_peer, "a=127.0.0.1:5,x", "44 characters"),
        (parse_link, "a@127.0.0.1:5", "must be A@HOST:PORT,B@HOST:PORT"),
        (parse_link, "a@127.0.0.1:5,b", "must be A@"),
        (parse_radio, "loss", "loss"),
        (parse_radio, "loss=3", "share"),
        (parse_radio, "los=0.3", "is an unknown key"),
    ],
)
def test_bad_flags_are_refused_with_what_to_write(parse: object, text: str, message: str) -> None:
    """ValueError, for the command line to print."""
    assert callable(parse)
    with pytest.raises(ValueError, match=re.escape(message)):
        parse(text)


def test_flags_go_before_the_file() -> None:
    """Given options replace the file's settings, also with the value 0."""
    settings = load_proxy_settings(EXAMPLE)
    changed = overridden(settings, seed=0, log=None, attacks=(), peers=(parse_peer("x=127.0.0.1:1"),))
    assert changed.peers[0].name == "x"
    assert changed.attacks == settings.attacks
    assert changed.log == settings.log
    assert overridden(settings, seed=9).seed == 9
