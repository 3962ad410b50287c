"""Configuration files for tests: a good one, and the parts of others."""

from __future__ import annotations

from base64 import b64encode
from pathlib import Path

import pytest

from uavlinkd.config import keys
from uavlinkd.config.load import load_config
from uavlinkd.config.model import Config, ConfigError

KEY = {
    name: keys.public_key_text(b64encode(bytes((number,)) * 32).decode())
    for number, name in enumerate(("drone1", "vps", "b", "c", "d"), 1)
}
"""Public keys. They are the same in every worker, because they are parts of the names of tests."""
TOP = 'name = "drone0"\nprivate_key_file = "drone0.key"\n'
LISTEN = 'listen = ["0.0.0.0:5790"]\n'
HEAD = TOP + LISTEN
URL = "udpin:127.0.0.1:14550"
ENDPOINT = f'[[endpoint]]\nname = "autopilot"\nurl = "{URL}"\n'
GCS = ENDPOINT.replace("autopilot", "gcs")
ADDRESSES = '["10.13.0.2:5790"]'
PEER = (
    f'[[peer]]\nname = "drone1"\npublic_key = "{KEY["drone1"]}"\naddresses = {ADDRESSES}\n'
    'role = "swarm-member"\nsystem_ids = [2]\n'
)
OTHER_PEER = f'[[peer]]\nname = "drone2"\npublic_key = "{KEY["b"]}"\nrole = "swarm-member"\nsystem_ids = [3]\n'
GOOD = HEAD + ENDPOINT + PEER
LTE = '[[network]]\nname = "lte"\ninterface = "wwan0"\nmetered = true\nbudget_bits_s = 256000\n'
MESH = '[[network]]\nname = "mesh"\naddress = "10.13.0.5"\n'
SIK = '[[network]]\nname = "sik"\nserial = "/dev/ttyUSB0:57600"\n'
HTTPS = '[relay_server]\nhttps = { listen = "127.0.0.1:5443", certificate = "tls.crt", key = "tls.key" }\n'
BY_MESH = '{ address = "10.13.0.9:5790", network = "mesh" }'
BY_SIK = '[{ network = "sik" }]'


def link(lines: str) -> str:
    """The good file with a section [link]."""
    return f"{HEAD}[link]\n{lines}\n{ENDPOINT}{PEER}"


def networks(sections: str, addresses: str = ADDRESSES, more: str = "") -> str:
    """The good file with networks, and other addresses of its peer."""
    return HEAD + sections + ENDPOINT + PEER.replace(ADDRESSES, addresses) + more


def relay(name: str = "vps", *, key: str = "", addresses: str = "", more: str = "") -> str:
    """A section."""
    at = addresses or f'["{"relay" if name == "vps" else name}.example.org:5790"]'
    return f'[[relay]]\nname = "{name}"\npublic_key = "{key or KEY[name]}"\naddresses = {at}\n{more}\n'


def relays(sections: str = "", peer: str = "", head: str = TOP) -> str:
    """A file with relays, whose confidential peer has no address of its own, unless ``peer`` has it."""
    text = PEER.replace(f"addresses = {ADDRESSES}", "confidential = true")
    return f"{head}{sections}{ENDPOINT}{text}{peer}\n"


def member(name: str = "b", key: str = "", more: str = "") -> str:
    """A section."""
    return f'[[member]]\nname = "{name}"\npublic_key = "{key or KEY[name]}"\n{more}\n'


def load(folder: Path, text: str) -> Config:
    """Load a text as drone0.toml beside a private key and a PSK."""
    for name, make in (("drone0.key", keys.generate_private_key), ("pair.psk", keys.generate_psk)):
        if not (folder / name).exists():
            keys.write_secret_file(folder / name, make())
    path = folder / "drone0.toml"
    path.write_text(text)
    return load_config(path, {})


def refused(folder: Path, text: str) -> dict[str, str]:
    """Load a text that has problems; return the messages by key."""
    with pytest.raises(ConfigError) as caught:
        load(folder, text)
    assert str(caught.value).count("\n") == len(caught.value.problems) - 1
    return {problem.key: problem.message for problem in caught.value.problems}
