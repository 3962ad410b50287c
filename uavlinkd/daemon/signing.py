"""Signatures at the endpoints of this daemon, and the change of a key: ``uavlinkd signing setup``, rotate and clear.

A change sends SETUP_SIGNING to the one autopilot behind an endpoint, while it is disarmed, and is done when the
autopilot has proven the new key. The caller keeps the key's file: a key that was sent may be in force.
"""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Final

import structlog

from uavlinkd.config.keys import decode_key
from uavlinkd.config.model import SigningConfig
from uavlinkd.daemon.features import Feature
from uavlinkd.daemon.local_endpoints import LocalEndpoints
from uavlinkd.io.ports import Endpoint, LocalPort
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.payloads import HEARTBEAT
from uavlinkd.mavlink.signing.endpoint_signing import LEAP, EndpointSigning
from uavlinkd.mavlink.signing.signature import LAST_TIMESTAMP, Signer, is_signed
from uavlinkd.mavlink.vehicles import Vehicles
from uavlinkd.protocol.crypto import Secret
from uavlinkd.system.clock import monotonic
from uavlinkd.system.folders import replace_file
from uavlinkd.system.guard import report
from uavlinkd.system.tasks import Threads

LISTENS_S: Final = 2.5
"""How long to listen for autopilots before a change: each sends a HEARTBEAT a second."""
CONFIRMED_S: Final = 4.0
"""How long to wait for the autopilot's proof: its slowest link is asked several times."""
REPEAT_S: Final = 0.5
"""Between two SETUP_SIGNING, and between two questions."""
RESERVE: Final = 5 * LEAP
"""How far the written timestamp is ahead of the used ones: it is written rarely."""
_LOOK_S: Final = 0.02
_THREAD: Final = Threads(1, "signing state")

OTHER_KEY: Final = (
    "the autopilot signs with a key that this daemon does not have: if a command was interrupted, run that one again;"
    " else put the key (its file, .new or .old) in its place, or remove it there (ArduPilot: over USB; PX4: delete"
    " mavlink/mavlink-signing-key.bin on its card, and restart it)"
)
_NOT_PROVEN: Final = "the autopilot has not proven that it has this endpoint's key: see `uavlinkd status`"
_SEVERAL_CLIENTS: Final = (
    "several clients are connected to this endpoint, and each would get the key: leave the autopilot alone there"
    " (a client is forgotten after a minute of silence)"
)
_UNKNOWN: Final[dict[str, object]] = {
    "problem": "the autopilot did not confirm it, and may have done it or not: run the same command again, and if"
    " that fails too, once more after a restart of the autopilot",
    "is_changed": None,
}


class _RefusalError(Exception):
    """Why a key cannot be changed now, in words. Nothing was changed."""


class AutopilotSigning(Feature):
    """The signing at the endpoints of one daemon: each has an :class:`.EndpointSigning`, or none.

    ``path``: of the file with a timestamp that is greater than all used. Without it frames pass as well, but an
    autopilot that forgot its own number accepts what was recorded in its earlier flights.
    """

    def __init__(
        self, local: LocalEndpoints, keep: Callable[[str, SigningConfig | None], object], path: Path | None
    ) -> None:
        self._local, self._path = local, path
        self._first = self._stored = 0 if path is None else _stored(path)
        self._writing: asyncio.Task[None] | None = None
        self.has_failed = False
        """Whether the file could not be written."""
        self._keep = keep  # in the running configuration: the file has it too
        self._changes = asyncio.Lock()

    def install(self, endpoint: Endpoint, config: SigningConfig) -> EndpointSigning:
        """Sign at an endpoint from now on."""
        signing = EndpointSigning(config.key, config.link_id, os.urandom, endpoint.failures)
        signing.timestamp = self._first
        signing.send = lambda raw: self._local.send_own(endpoint, raw, monotonic())
        deliver = endpoint.handler.on_frames

        def on_frames(port: LocalPort, frames: list[Frame], now: float, epoch: int, waited_s: float = 0.0) -> None:
            before = signing.proven_at
            passed = signing.accept(frames, now)
            if passed or signing.proven_at != before:
                port.is_genuine = True
            if passed:
                deliver(port, passed, now, epoch, waited_s)

        endpoint.signing, endpoint.on_frames = signing, on_frames
        return signing

    def _remove(self, endpoint: Endpoint) -> None:
        if endpoint.signing is not None:
            self._first = max(self._first, endpoint.signing.timestamp)
            endpoint.signing, endpoint.on_frames = None, endpoint.handler.on_frames

    def do_housekeeping(self, now: float) -> None:
        """Write a later timestamp, in a thread, when the written one is reached."""
        signings = (endpoint.signing for endpoint in self._local.endpoints)
        used = max((one.timestamp for one in signings if one is not None), default=0)
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
        config = SigningConfig(Secret(decode_key(asked["key"])), asked["link_id"]) if asked["key"] else None
        endpoint = next((one for one in self._local.endpoints if one.name == asked["endpoint"]), None)
        try:
            if endpoint is None or endpoint.is_station:
                raise _RefusalError(f"the daemon has no endpoint {asked['endpoint']} for an autopilot: restart it")
            if self._changes.locked():
                raise _RefusalError("another change of a key goes on: wait for its end")
            async with self._changes:
                answer = await self._change(endpoint, asked["action"], config)
        except _RefusalError as refusal:
            return {"problem": str(refusal), "is_changed": False}
        if answer["is_changed"]:
            self._keep(endpoint.name, config)
        return answer

    async def _change(self, endpoint: Endpoint, action: str, config: SigningConfig | None) -> dict[str, object]:
        before = endpoint.signing
        if before is None and action == "rotate":
            raise _RefusalError(f"the daemon does not sign at {endpoint.name}: `uavlinkd signing setup` begins it")
        system, signs = await _listen(endpoint)
        if config is None:
            return await self._clear(endpoint, system, signs=signs)
        if len(endpoint.ports) > 1:
            raise _RefusalError(_SEVERAL_CLIENTS)
        signing = before or self.install(endpoint, config)
        newest = signing.add(config.key)  # the autopilot has it after a change that was interrupted
        answer: dict[str, object] = {"is_changed": False}
        try:
            began_at = monotonic()
            if (signs or action == "rotate") and not await _proves(signing, began_at):
                raise _RefusalError(OTHER_KEY if signs and signing.verified_at < 0 else _NOT_PROVEN)
            answer = await _give(endpoint, signing, newest, system, began_at)
        finally:
            if before is None and not answer["is_changed"]:
                self._remove(endpoint)
        return answer

    async def _clear(self, endpoint: Endpoint, system: int, *, signs: bool) -> dict[str, object]:
        if signs:
            if (signing := endpoint.signing) is None:
                raise _RefusalError(OTHER_KEY)
            if not await _proves(signing, monotonic()):
                raise _RefusalError(_NOT_PROVEN)
            await _repeat(lambda: signing.set_up(None, system), lambda: False, 2 * REPEAT_S)
            try:
                _, signs = await _listen(endpoint)
            except _RefusalError:
                return _UNKNOWN
            if signs:
                return _UNKNOWN
        self._remove(endpoint)
        return {"problem": "", "is_changed": True}


def _stored(path: Path) -> int:
    """The timestamp in the file of an earlier start; 0 if there is none."""
    try:
        timestamp = int(path.read_bytes()[:20])
    except (OSError, ValueError):
        return 0
    return timestamp if 0 < timestamp < LAST_TIMESTAMP else 0


async def _listen(endpoint: Endpoint) -> tuple[int, bool]:
    """The system of the one autopilot behind an endpoint, and whether it signs, with any key."""
    vehicles, signing, deliver = Vehicles(), set[int](), endpoint.on_frames

    def on_frames(port: LocalPort, frames: list[Frame], now: float, *more: object) -> None:
        for frame in frames:
            if frame.header.msgid == HEARTBEAT:
                vehicles.note(frame, now)
                signing.update([frame.header.system] if is_signed(frame.raw) else ())
        deliver(port, frames, now, *more)

    endpoint.on_frames = on_frames
    try:
        await asyncio.sleep(LISTENS_S)
    finally:
        endpoint.on_frames = deliver
    heard = {one["system"]: one["is_armed"] for one in vehicles.status(monotonic())}
    if not heard:
        raise _RefusalError(
            f"no autopilot was heard for {LISTENS_S:g} s: is it on? Does `uavlinkd status` show frames?"
        )
    if len(heard) > 1:
        systems = " and ".join(map(str, heard))
        raise _RefusalError(f"several autopilots are behind this endpoint (systems {systems}): each needs its own")
    ((system, is_armed),) = heard.items()
    if is_armed:
        raise _RefusalError("the autopilot is armed, and takes no key then: disarm it, and run the command again")
    return system, system in signing


async def _proves(signing: EndpointSigning, began_at: float) -> bool:
    """Whether the autopilot proves a key now: one that was erased since its last proof does not."""
    signers = cycle(signing.signers)
    return await _repeat(lambda: signing.ask(next(signers), monotonic()), lambda: signing.proven_at >= began_at)


async def _give(
    endpoint: Endpoint, signing: EndpointSigning, newest: Signer, system: int, began_at: float
) -> dict[str, object]:
    def has_it() -> bool:
        return signing.signer is newest and signing.is_proven and signing.proven_at >= began_at

    def hand_over() -> None:
        if len(endpoint.ports) == 1:  # another one may have come since
            signing.set_up(newest.secret, system)
        signing.ask(newest, monotonic())

    if not await _repeat(hand_over, has_it):
        return _UNKNOWN
    signing.accepts_unsigned = False
    accepts = await _repeat(lambda: signing.ask(None, monotonic()), lambda: signing.accepts_unsigned, 2 * REPEAT_S)
    return {"problem": "", "is_changed": True, "system": system, "accepts_unsigned": accepts}


async def _repeat(send: Callable[[], object], is_done: Callable[[], bool], seconds: float = CONFIRMED_S) -> bool:
    """Send again and again until it is done. Returns whether that was in time."""
    end = monotonic() + seconds
    again_at = 0.0
    while not is_done():
        if (now := monotonic()) >= end:
            return False
        if now >= again_at:
            again_at = now + REPEAT_S
            send()
        else:  # a frame must not pay for an event
            await asyncio.sleep(_LOOK_S)
    return True
