"""The configuration of the man in the middle."""

from __future__ import annotations

from pathlib import Path

from uavlinkd.lab.mitm.attack import Direction
from uavlinkd.lab.mitm.proxy_settings import ProxySettings, load_proxy_settings
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
    """configs/mitm.toml loads; its socket is beside it; both keys are known."""
    settings = load_proxy_settings(EXAMPLE)
    assert [attack.name for attack in settings.attacks] == ["replay-data", "tamper-key"]
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
