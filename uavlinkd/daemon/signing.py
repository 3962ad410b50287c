"""Signatures at the endpoints of this daemon, and the change of a key: ``uavlinkd signing setup``, rotate and clear.

A change sends SETUP_SIGNING to the one autopilot behind an endpoint, while it is disarmed, and is done when the
autopilot has proven the new key. The caller keeps the key's file: a key that was sent may be in force.
"""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import Callable, Mapping
from itertools import count
from pathlib import Path
from typing import Final

import structlog

from uavlinkd.config.keys import decode_key
from uavlinkd.config.model import EndpointConfig, SigningConfig
from uavlinkd.daemon.features import Feature
from uavlinkd.daemon.local_endpoints import LocalEndpoints
from uavlinkd.io.ports import Endpoint, LocalPort
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.mavlink.signing.endpoint_signing import LEAP, EndpointSigning
from uavlinkd.mavlink.signing.signature import LAST_TIMESTAMP
from uavlinkd.protocol.crypto import Secret
from uavlinkd.system.clock import monotonic
from uavlinkd.system.folders import replace_file
from uavlinkd.system.guard import report
from uavlinkd.system.tasks import Threads

HEARD_S: Final = 3.0
"""An autopilot whose last HEARTBEAT is older is not there. They send one a second."""
CONFIRMED_S: Final = 4.0
"""How long to wait for the autopilot's proof: its slowest link is asked several times."""
LISTENS_S: Final = 2.5
"""How long to listen before the first key: there may be several autopilots."""
REPEAT_S: Final = 0.5
"""Between two SETUP_SIGNING."""
FIRST_JUMP: Final = 40
"""The second SETUP_SIGNING begins with this power of two as its timestamp. The next ones double it."""
RESERVE: Final = 5 * LEAP
"""How far the written timestamp is ahead of the used ones: it is written rarely."""
_LOOK_S: Final = 0.02
_THREAD: Final = Threads(1, "signing state")

OTHER_KEY: Final = (
    "the autopilot signs with a key that this daemon does not have: give the key's file, or remove the key there"
    " (ArduPilot: over USB; PX4: delete mavlink/mavlink-signing-key.bin on its card, and restart it)"
)
_NOT_PROVEN: Final = "the autopilot has not proven that it has this endpoint's key: see `uavlinkd status`"
_SEVERAL_CLIENTS: Final = (
    "several clients are connected to this endpoint, and each would get the key: leave the autopilot alone there"
    " (a client is forgotten after a minute of silence)"
)
_UNKNOWN: Final[dict[str, object]] = {
    "problem": f"the autopilot did not confirm it within {CONFIRMED_S:g} s, and may have done it or not: run the same"
    " command again, which uses the same key",
    "is_changed": None,
}


class AutopilotSigning(Feature):
    """The signing at the endpoints of one daemon: each has an :class:`.EndpointSigning`, or none.

    ``path``: of the file with a timestamp that is greater than all used. Without it frames pass as well, but an
    autopilot that forgot its own number accepts what was recorded in its earlier flights.
    """

    def __init__(
        self, local: LocalEndpoints, keep: Callable[[str, SigningConfig], object], path: Path | None
    ) -> None:
        self._local, self._path = local, path
        self._stored = 0 if path is None else _stored(path)
        self._writing: asyncio.Task[None] | None = None
        self.has_failed = False
        """Whether the file could not be written."""
        self._keep = keep  # in the running configuration: the file has it too
        self._is_changing = False

    def install(self, endpoint: Endpoint, config: EndpointConfig) -> None:
        """Sign at an endpoint with the keys of the file."""
        self._install(endpoint, config.signing)

    def _install(self, endpoint: Endpoint, config: SigningConfig, *, is_open: bool = False) -> EndpointSigning:
        signing = EndpointSigning(config.keys, config.link_id, os.urandom, endpoint.failures, is_open=is_open)
        signing.timestamp = self._stored
        signing.send = lambda raw: self._local.send_own(endpoint, raw, monotonic())
        deliver = endpoint.handler.on_frames

        def on_frames(port: LocalPort, frames: list[Frame], now: float, epoch: int, waited_s: float = 0.0) -> None:
            if passed := signing.accept(frames, now):
                deliver(port, passed, now, epoch, waited_s)

        def sign(frame: Frame, source: Source) -> Frame | None:
            return signing.sign(frame, source.name)  # not by client: a captured station opens more of them

        endpoint.signing, endpoint.on_frames = signing, on_frames
        endpoint.delivered.set_sign(sign)
        return signing

    def _remove(self, endpoint: Endpoint) -> None:
        endpoint.signing, endpoint.on_frames = None, endpoint.handler.on_frames
        endpoint.delivered.set_sign(None)

    def do_housekeeping(self, now: float) -> None:
        """Write a later timestamp, in a thread, when the written one is reached."""
        used = max((one.signing.timestamp for one in self._local.endpoints if one.signing is not None), default=0)
        if used > self._stored and self._writing is None and self._path is not None:
            self._writing = asyncio.get_running_loop().create_task(self._write(self._path, used + RESERVE))

    async def _write(self, path: Path, timestamp: int) -> None:
        try:
            await _THREAD.run(replace_file, path, b"%d\n" % timestamp)
            self._stored = timestamp
        except OSError as error:
            if not self.has_failed:
                reason = f"{error.strerror}: after a power cut, recorded frames may pass at the autopilot's cable"
                structlog.get_logger().warning("signing_state_not_written", file=str(path), reason=reason)
            self.has_failed = True
        except Exception as error:
            report(error)
        finally:
            self._writing = None

    # Changes.

    async def answer(self, wish: str) -> dict[str, object]:
        """Change a key. ``wish``: ``action``, ``endpoint``, ``key`` and ``link_id`` as JSON.

        The answer has a ``problem``, or nothing there. ``is_changed``: whether the autopilot has the new key; None if
        that is not known.
        """
        asked = json.loads(wish)
        endpoint = next((one for one in self._local.endpoints if one.name == asked["endpoint"]), None)
        if endpoint is None or endpoint.is_station:
            return _nothing(f"the daemon has no endpoint {asked['endpoint']} for an autopilot: restart it")
        if self._is_changing:
            return _nothing("another change of a key goes on: wait for its end")
        self._is_changing = True
        try:
            key = Secret(decode_key(asked["key"])) if asked["key"] else None
            answer = await self._change(endpoint, asked["action"], key, asked["link_id"])
        finally:
            self._is_changing = False
            if endpoint.signing is not None:
                endpoint.signing.may_lack_key = False
        if answer["is_changed"]:
            link_id = asked["link_id"] if endpoint.signing is None else endpoint.signing.link_id
            self._keep(endpoint.name, SigningConfig(() if key is None else (key,), link_id))
        return answer

    async def _change(self, endpoint: Endpoint, action: str, key: Secret | None, link_id: int) -> dict[str, object]:
        signing, is_new = endpoint.signing, endpoint.signing is None
        if signing is None:
            if key is None or action != "setup":
                return _nothing(f"the daemon does not sign at {endpoint.name}: `uavlinkd signing setup` begins it")
            signing = self._install(endpoint, SigningConfig((key,), link_id), is_open=True)
        if signing.is_open:
            await _until(lambda: signing.is_proven, LISTENS_S)
        elif await _answers(signing):
            await _until(lambda: bool(_heard(signing)), HEARD_S)
        elif action == "rotate":  # another key is for the autopilot that proves this one: its file will be replaced
            return _nothing(_NOT_PROVEN)
        else:
            signing.is_proven, signing.has_foreign_key, signing.may_lack_key = False, False, True
            await asyncio.sleep(LISTENS_S)
        if key is not None and signing.is_proven and signing.signer.secret == key:
            return await _done(signing)
        heard = _heard(signing)
        problem = _problem(signing, heard)
        if problem is None and key is not None and len(endpoint.ports) > 1:
            problem = _SEVERAL_CLIENTS
        if problem is not None:
            if is_new:
                self._remove(endpoint)
            return _nothing(problem)
        (system,) = heard
        if key is None:
            return await self._clear(endpoint, signing, system)
        newest, attempts = signing.add(key), count()

        def set_up() -> None:
            # Until it restarts, the autopilot refuses timestamps below those that this daemon used with another key.
            if attempt := next(attempts):
                signing.timestamp = max(signing.timestamp, 1 << (FIRST_JUMP - 1 + attempt))
            signing.set_up(key, system)
            signing.ask(newest, monotonic())

        await _repeat(set_up, lambda: signing.is_proven and signing.signer is newest)
        return await _done(signing) if signing.signer is newest and signing.is_proven else _UNKNOWN

    async def _clear(self, endpoint: Endpoint, signing: EndpointSigning, system: int) -> dict[str, object]:
        if signing.is_proven:
            signing.may_lack_key = True
            await _repeat(lambda: signing.set_up(None, system), lambda: _lacks_key(signing), HEARD_S + CONFIRMED_S)
            if not _lacks_key(signing):
                return _UNKNOWN
        self._remove(endpoint)
        return {"problem": "", "is_changed": True, "system": system, "accepts_unsigned": True}


def _stored(path: Path) -> int:
    """The timestamp in the file of an earlier start; 0 if there is none."""
    try:
        timestamp = int(path.read_bytes()[:20])
    except (OSError, ValueError):
        return 0
    return timestamp if 0 < timestamp < LAST_TIMESTAMP else 0


async def _answers(signing: EndpointSigning) -> bool:
    """Whether the autopilot proves its key now: one that was erased since its last proof does not."""
    began_at = monotonic()
    await _repeat(lambda: signing.ask(signing.signer, monotonic()), lambda: signing.proven_at >= began_at, HEARD_S)
    return signing.proven_at >= began_at


def _heard(signing: EndpointSigning) -> dict[int, bool]:
    """The autopilots behind an endpoint now: whether each is armed, by its system."""
    vehicles = signing.vehicles.status(monotonic())
    return {one["system"]: one["is_armed"] for one in vehicles if one["heartbeat_s"] < HEARD_S}


def _lacks_key(signing: EndpointSigning) -> bool:
    """Whether HEARTBEATs come without a signature, and no frame with one: a stranger can send the former."""
    return monotonic() - signing.unsigned_at < HEARD_S <= monotonic() - signing.verified_at


def _problem(signing: EndpointSigning, heard: Mapping[int, bool]) -> str | None:
    """Why the autopilot cannot get a key now."""
    if not signing.is_proven and signing.has_foreign_key:
        return OTHER_KEY
    if not heard:
        return f"no autopilot was heard for {HEARD_S:g} s: is it on, and does `uavlinkd status` show its frames?"
    if not (signing.is_proven or _lacks_key(signing)):
        return _NOT_PROVEN
    if len(heard) > 1:
        systems = " and ".join(map(str, sorted(heard)))
        return f"several autopilots are behind this endpoint (systems {systems}): give each an endpoint of its own"
    if any(heard.values()):
        return "the autopilot is armed, and takes no key then: disarm it, and run the command again"
    return None


async def _done(signing: EndpointSigning) -> dict[str, object]:
    """Ask whether the autopilot still takes what is unsigned."""
    signing.accepts_unsigned = False
    await _repeat(lambda: signing.ask(None, monotonic()), lambda: signing.accepts_unsigned, 2 * REPEAT_S)
    return {
        "problem": "",
        "is_changed": True,
        "system": next(iter(_heard(signing)), 0),
        "accepts_unsigned": signing.accepts_unsigned,
    }


async def _repeat(send: Callable[[], object], is_done: Callable[[], bool], seconds: float = CONFIRMED_S) -> None:
    end = monotonic() + seconds
    while monotonic() < end and not is_done():
        send()
        await _until(is_done, REPEAT_S)


async def _until(is_done: Callable[[], bool], seconds: float) -> None:
    end = monotonic() + seconds
    while not is_done() and monotonic() < end:  # noqa: ASYNC110  a frame must not pay for an event
        await asyncio.sleep(_LOOK_S)


def _nothing(problem: str) -> dict[str, object]:
    return {"problem": problem, "is_changed": False}
