"""The stage of a hostile proxy: a member reaches its relay by TLS through it, and the other member directly."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Final

from uavlinkd.config.keys import encode_key
from uavlinkd.lab.evaluation.middle import HOST, MiddleHere
from uavlinkd.lab.evaluation.records import EvaluationError
from uavlinkd.lab.evaluation.tampering_stages import RelayStage
from uavlinkd.lab.hostile.web_proxy import ALL_ATTACKS, WebContext, WebProxy
from uavlinkd.lab.mitm.attack import AttackObject, Direction
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.sim.drone_process import DroneProcess
from uavlinkd.lab.sim.loopback_ports import free_ports

_FILES: Final = "tls.crt", "tls.key"
_MAKE: Final = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 1 -subj /CN=relay"


def _write_certificate(folder: Path) -> None:
    """One that nothing verifies, and its key. Raises EvaluationError without OpenSSL's command."""
    command = [*_MAKE.split(), "-out", _FILES[0], "-keyout", _FILES[1]]
    try:
        subprocess.run(command, cwd=folder, check=True, capture_output=True)  # noqa: S603  constant command
    except (OSError, subprocess.CalledProcessError) as error:
        raise EvaluationError(f"no certificate for the relay: {error}. Install openssl") from None


class MiddleWeb(MiddleHere):
    """A relay in a process of its own, and a hostile proxy between it and the first member, in this process."""

    def __init__(self, names: Sequence[str], folder: Path, seed: int) -> None:
        super().__init__(names, seed, paths=2)
        self._names = tuple(names)
        self._port, self._https_port, udp_port, endpoint_port = free_ports(4)
        self._relay = DroneProcess("vps", folder / "vps", udp_port, endpoint_port)
        self._relay.command = "relay"
        _write_certificate(folder / "vps")
        self._web: WebProxy | None = None

    def section(self, name: str) -> dict[str, object]:
        """The relay, for a member."""
        port = self._port if name == self._names[0] else self._https_port
        return {"name": "vps", "public_key": self._relay.public_key, "addresses": [f"wss://{HOST}:{port}/uavlink"]}

    async def start(self, addresses: Mapping[str, int], public_keys: Mapping[str, bytes]) -> None:
        """Start all. The ports of the members are not needed."""
        del addresses
        files = dict(zip(("certificate", "key"), _FILES, strict=True))
        sections: list[tuple[str, Mapping[str, object]]] = [
            ("[[member]]", {"name": name, "public_key": encode_key(public_keys[name])}) for name in self._names
        ]
        https = {"listen": f"{HOST}:{self._https_port}", **files}
        self._relay.write([*sections, ("[relay_server]", {"https": https})])
        await self._relay.start()
        near, far = self._names
        ports = [
            {path: self.ports[Direction(one, other, path)] for path in (1, 2)}
            for one, other in ((near, far), (far, near))
        ]
        web = self._web = WebProxy(self._port, self._https_port, (ports[0], ports[1]))
        ends = {name: end.udp.getsockname()[1] for name, end in ((near, web.to_member), (far, web.to_relay))}
        await super().start(ends, public_keys)
        web.start(*(str(self._relay.folder / file) for file in _FILES))

    async def attack(self, specs: Sequence[str], objects: Sequence[AttackObject] = ()) -> None:
        assert not objects, "the proxy has no keys"
        assert self._web is not None, "it was started"
        here, now = self.context, monotonic()
        context = WebContext(here.directions, here.public_keys, proxy=self._web, member=self._names[0])
        made = [
            parse_attack(text, ALL_ATTACKS).make(context, f"{self._seed} {position}", now)
            for position, text in enumerate(specs)
        ]
        self.proxy.change_attacks(made)

    async def stop(self) -> None:
        if self._web is not None:
            await self._web.stop()
            self._web = None
        await super().stop()
        await self._relay.stop()


class WebStage(RelayStage):
    """Two daemons that know only a relay, by TLS; the first one through a hostile proxy."""

    middle: MiddleWeb  # type: ignore[assignment]

    def relays(self, name: str) -> list[dict[str, object]]:
        return [self.middle.section(name)]
