"""The configuration of the man in the middle: all problems at once."""

from __future__ import annotations

from pathlib import Path

import pytest

from uavlinkd.lab.mitm.attack import Direction
from uavlinkd.lab.mitm.proxy_settings import ProxySettings, SettingsError, load_proxy_settings
from uavlinkd.lab.mitm.radio import Bursts
from uavlinkd.system.addresses import Address

EXAMPLE = Path(__file__).parents[3] / "configs" / "mitm.toml"
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
        ("attack = [3]" + GOOD, ["attack[0]: must be a table"]),
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
        ("log = 3\nseed = 'x'" + GOOD, ["log: ", "seed: "]),
    ],
)
def test_every_problem_is_reported_with_its_place(tmp_path: Path, text: str, problems: list[str]) -> None:
    """File, key and what to write; all of them together."""
    with pytest.raises(SettingsError) as caught:
        _load(tmp_path, text)
    assert len(caught.value.problems) == len(problems), caught.value
    for problem, expected in zip(sorted(caught.value.problems), sorted(problems), strict=True):
        assert f"mitm.toml: {expected}" in problem
