"""Mistakes in a file or a command line: `check`, or the command itself, answers."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path

from tests.mistakes.row import Mistake
from tests.mistakes.scene import Scene, checked_file, said
from uavlinkd.config import keys

Change = Callable[[str, Path], str]
Make = Callable[[Scene], Awaitable[None]]


def _public() -> str:
    return keys.public_key_text(keys.generate_private_key())


def _good() -> str:
    return (
        f'name = "drone0"\nprivate_key_file = "drone0.key"\ncontrol_socket = "drone0.sock"\n'
        f'listen = ["0.0.0.0:15790"]\n[[endpoint]]\nname = "autopilot"\n'
        f'url = "udpin:127.0.0.1:15791"\n[[peer]]\nname = "drone1"\npublic_key = "{_public()}"\n'
        f'addresses = ["127.0.0.1:15792"]\nrole = "swarm-member"\nsystem_ids = [2]\n'
    )


_PEER = '[[peer]]\nname = "drone2"\npublic_key = "{}"\nrole = "swarm-member"\nsystem_ids = [3]\n'


def _replaced(old: str, new: str) -> Change:
    def change(text: str, folder: Path) -> str:
        assert old in text, old
        return text.replace(old, new)

    return change


def _line(start: str, new: str) -> Change:
    """Replace the line that starts so."""
    return lambda text, folder: "".join(
        f"{new}\n" if line.startswith(start) else line for line in text.splitlines(keepends=True)
    )


def _added(lines: str) -> Change:
    return lambda text, folder: text + lines


def _file(change: Change) -> Make:
    """`check` of a good file with one mistake."""

    async def make(scene: Scene) -> None:
        folder = scene.stage.folder / f"file{scene.row}"
        folder.mkdir()
        keys.write_secret_file(folder / "drone0.key", keys.generate_private_key())
        path = folder / "drone0.toml"
        path.write_bytes(change(_good(), folder).encode())
        scene.check = checked_file(path)

    return make


def _own_key(text: str, folder: Path) -> str:
    own = keys.public_key_text((folder / "drone0.key").read_text())
    return _line("public_key", f'public_key = "{own}"')(text, folder)


def _mode(text: str, folder: Path) -> str:
    (folder / "drone0.key").chmod(0o644)
    return text


def _psk(text: str, folder: Path) -> str:
    keys.write_secret_file(folder / "pair.psk", keys.generate_private_key())
    pasted = (folder / "pair.psk").read_text().strip()
    return _line("public_key", f'public_key = "{pasted}"\npsk_file = "pair.psk"')(text, folder)


def _public_as_private(text: str, folder: Path) -> str:
    (folder / "drone0.key").write_text(_public())
    return text


def _one_psk(text: str, folder: Path) -> str:
    keys.write_secret_file(folder / "pair.psk", keys.generate_psk())
    return f'{text}psk_file = "pair.psk"\n{_PEER.format(_public())}psk_file = "pair.psk"\n'


def _same_port(text: str, folder: Path) -> str:
    listen = text.split('listen = ["0.0.0.0:')[1].split('"', maxsplit=1)[0]
    return _line("url", f'url = "udpin:127.0.0.1:{listen}"')(text, folder)


def _own_address(text: str, folder: Path) -> str:
    listen = text.split('listen = ["0.0.0.0:')[1].split('"', maxsplit=1)[0]
    return _line("addresses", f'addresses = ["127.0.0.2:{listen}"]')(text, folder)


def _two_of_one(text: str, folder: Path) -> str:
    return text + _PEER.format(text.split('public_key = "')[1].split('"', maxsplit=1)[0])


def _two_on_one_port(text: str, folder: Path) -> str:
    url = text.split('url = "')[1].split('"', maxsplit=1)[0]
    return f'{text}[[endpoint]]\nname = "gcs"\nurl = "{url}"\n'


def _shared_address(text: str, folder: Path) -> str:
    address = text.split("addresses = ")[1].split("\n", maxsplit=1)[0]
    return f"{text}{_PEER.format(_public())}addresses = {address}\n"


def _wg(text: str, folder: Path) -> str:
    return f"[Interface]\nPrivateKey = {keys.generate_private_key()}\n[Peer]\nPublicKey = {_public()}\n"


_ROWS: tuple[tuple[str, str, str, Change], ...] = (
    (
        "2",
        "own key as the peer's",
        r"this daemon's own key: write what `uavlinkd pubkey` prints.* or private_key_file is that of",
        _own_key,
    ),
    ("5", "truncated key", r"is not a key: .*write what", _line("public_key", f'public_key = "{"A" * 40}"')),
    ("8", "`private_keyfile`", r"did you mean private_key_file", _replaced("private_key_file", "private_keyfile")),
    ("9", "`adresses`", r"did you mean addresses", _replaced("addresses", "adresses")),
    ("10", "role `drone`", r"the roles are vehicle", _replaced("swarm-member", "drone")),
    ("11", "message `ATITUDE`", r"did you mean 'ATTITUDE'", _added('allow_in = ["ATITUDE"]\n')),
    (
        "12",
        "two peers with one system id",
        r"may send as the same system 2: .*allow each system for one",
        lambda text, folder: text + _PEER.format(_public()).replace("[3]", "[2]"),
    ),
    ("13", "key file that others may read", r"chmod 600", _mode),
    ("14", "key file missing", r"uavlinkd keygen --out", _replaced("drone0.key", "drone9.key")),
    ("15", "closing quotation mark missing", r':1:.*write name = "drone0"', _replaced('"drone0"\n', '"drone0\n')),
    ("15b", "`[peer]`", r"\[\[peer\]\]", _replaced("[[peer]]", "[peer]")),
    (
        "15c",
        "`:` for `=`",
        r''':1:.*Expected '=' after a key.*write name = "drone0"''',
        _replaced('name = "drone0"', 'name: "drone0"'),
    ),
    ("16", "endpoint on the port of `listen`", r"the port that `listen` has for peers.*write another", _same_port),
    (
        "21",
        "serial device without `serial:`",
        r"write serial:/dev/ttyACM0:57600",
        _line("url", 'url = "/dev/ttyACM0,57600"'),
    ),
    (
        "22",
        "IPv6 address without brackets",
        r"needs brackets: write \[::\]:5790",
        _line("listen", 'listen = [":::5790"]'),
    ),
    (
        "24",
        "`fe80::` address without interface",
        r"write \[fe80::1%wlan0\]:5790",
        _line("addresses", 'addresses = ["[fe80::1]:5790"]'),
    ),
    ("29", "`tag_bits = 100`", r"64, 96, 128 or 256", _added("tag_bits = 100\n")),
    (
        "34",
        "ML-KEM over a small MTU",
        r"exceeds an MTU of 1,500, so every path must carry fragments",
        _added('suites = ["mlkem1024"]\n'),
    ),
    ("37", "one peer twice", r"is the key of peer\[0\] \(drone1\) too: each peer has its own", _two_of_one),
    ("41", "`system_ids = [0]`", r"system_ids.*255", _replaced("system_ids = [2]", "system_ids = [0]")),
    ("42", "address without port", r"write 10\.13\.0\.2:5790", _line("addresses", 'addresses = ["10.13.0.2"]')),
    ("44", "`udp:`", r"write udpin:.* or udpout:", _line("url", 'url = "udp:127.0.0.1:14540"')),
    (
        "45",
        "endpoint open to the network",
        r"listens beyond loopback.*write udpin:127\.0\.0\.1",
        _replaced("udpin:127.0.0.1", "udpin:0.0.0.0"),
    ),
    ("49", "no role", r"role.*system_ids|role", _line("role", "")),
    ("55", "WireGuard's wg.conf", r"is a WireGuard file.*start from configs/drone0\.toml", _wg),
    (
        "59",
        "public key in the private key's file",
        r"without the form of a private key.*`uavlinkd keygen`",
        _public_as_private,
    ),
    ("60", "PSK as a public key", r"is a PSK.*make a new PSK", _psk),
    (
        "61",
        "mavlink-router's file",
        r"is a file of mavlink-router.*start from configs/drone0\.toml",
        lambda text, folder: "[UdpEndpoint uavlinkd]\nMode = Normal\n",
    ),
    (
        "62",
        "key file given as the configuration",
        r"is a key file.*give the \.toml file",
        lambda text, folder: keys.generate_private_key(),
    ),
    ("64", "typographic quotation marks", r":1:.*straight quotation marks", _replaced('"drone0"', "“drone0”")),
    ("65", "`True`", r"write confidential = true", _added("confidential = True\n")),
    (
        "66",
        "second `[[peer]]` forgotten",
        r"write a key once in its section.*\[\[peer\]\]",
        lambda text, folder: text + _PEER.format(_public()).removeprefix("[[peer]]\n"),
    ),
    ("67", "unit after a number", r"write keepalive_s = 10", _added("keepalive_s = 10s\n")),
    (
        "68",
        "list without its bracket",
        r'its value has no end: write listen = \["0\.0',
        _replaced('"]\n[[endpoint]]', '"\n[[endpoint]]'),
    ),
    (
        "69",
        "folder of the control socket missing",
        r"mkdir -p /no/such",
        _replaced('"drone0.sock"', '"/no/such/c.sock"'),
    ),
    (
        "70",
        "listens on loopback only",
        r"listen names only loopback: neither reaches the other",
        lambda text, folder: _line("addresses", 'addresses = ["10.13.0.2:5790"]')(
            text.replace("0.0.0.0", "127.0.0.1"), folder
        ),
    ),
    ("71", "own address as the peer's", r"where this daemon listens: write the peer's", _own_address),
    ("72", "one PSK for two peers", r"make one for each pair with `uavlinkd psk`", _one_psk),
    ("73", "two peers at one address", r"share the address .* only one peer can use it", _shared_address),
    (
        "76",
        "two endpoints on one port",
        r"listens where endpoint\[0\] \(autopilot\) does: write another port",
        _two_on_one_port,
    ),
)


def _fleet(*arguments: str) -> Make:
    """A fleet command in the folder of a fleet."""

    async def make(scene: Scene) -> None:
        folder = scene.stage.folder / f"fleet{scene.row}"
        said("fleet", "init", *_RELAY, "--drones", "2", "--no-passphrase", "--out", str(folder))
        out = [] if "--out" in arguments else ["--out", str(folder)]
        scene.command = said("fleet", *(word.replace("FLEET", str(folder)) for word in arguments), *out)

    return make


_RELAY = ("--relay", "relay.example.org:5790")
_NEW = ("--no-passphrase", "--out", "FLEET/new")
_FLEET: tuple[tuple[str, str, str, Make], ...] = (
    (
        "56a",
        "fleet init over a fleet",
        r"exists already: choose the name of a new folder",
        _fleet("init", "--no-passphrase", "--out", "FLEET"),
    ),
    ("56b", "fleet whose members would not meet", r"needed \(init --relay", _fleet("init", "--drones", "2", *_NEW)),
    ("56c", "fleet of 300", r"at most 255 members", _fleet("init", "--drones", "300", *_NEW)),
    ("56d", "unknown suite", r"does not exist: use one of x25519", _fleet("init", "--suite", "rsa", *_NEW)),
    ("56e", "relay without a port", r"--relay: has no port", _fleet("init", "--relay", "relay.example.org", *_NEW)),
    ("56f", "address of no machine", r"write the one that the others", _fleet("init", "--relay", "0.0.0.0:1", *_NEW)),
    (
        "56g",
        "address without a ground station",
        r"more --station-address than --ground-stations",
        _fleet("init", "--station-address", "10.13.0.254:5790", *_NEW),
    ),
    ("56h", "name that exists", r'has a "drone1" already', _fleet("add", "drone1")),
    ("56i", "name with a space", r"write 1 to 21 of a-z", _fleet("add", "drone 9")),
    ("56j", "system id that is taken", r"would have the system id of drone1", _fleet("add", "scout", "--id", "1")),
    ("56k", "unknown member", r'has no "drone9": its members are', _fleet("revoke", "drone9")),
    ("56l", "name that looks like another", r'looks like "drone1"', _fleet("add", "dronel")),
)


async def _no_control_socket(scene: Scene) -> None:
    del scene.here.config["control_socket"]
    scene.command = said("status", "--config", str(scene.here.write_config()))


async def _windows(scene: Scene) -> None:
    """An editor of Windows wrote a byte order mark and its line ends."""
    path = scene.here.write_config()
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    scene.check = checked_file(path)


FILE_ROWS = (
    *(Mistake(row, name, _file(change), check=pattern) for row, name, pattern, change in _ROWS),
    *(Mistake(row, name, make, command=pattern) for row, name, pattern, make in _FLEET),
    Mistake("40", "no `control_socket`", _no_control_socket, command=r'add control_socket = "NAME\.sock"'),
    Mistake("43", "file of a Windows editor", _windows, check=r"public key"),
)
