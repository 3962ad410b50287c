"""A node whose shell decides on certificates at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from uavlinkd.protocol.drops import Drop
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import CertificateShown, Output, PeerAdmitted
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.settings import PeerSettings

Admit = Callable[[bytes, bytes, float], PeerSettings]
"""Returns the settings of the peer with this key that shows this certificate now, or raises Drop. Changes nothing."""


class AdmittingNode(Node):
    """``admit``: None if no certificate is valid."""

    def __init__(self, *arguments: Any, admit: Admit | None, **options: Any) -> None:
        super().__init__(*arguments, takes_certificates=admit is not None, **options)
        self._decide = admit
        self.accepts = True
        """Whether a peer that proved itself is accepted at once."""

    def receive(self, datagram: bytes, path: Path, now: float, *, is_screened: bool = False) -> list[Output]:
        out: list[Output] = []
        for output in super().receive(datagram, path, now, is_screened=is_screened):
            out += self._answer(output, now) if isinstance(output, CertificateShown) else [output]
            if isinstance(output, PeerAdmitted) and isinstance(output.peer, Peer) and self.accepts:
                self.accept(output.peer)
        return out

    def _answer(self, shown: CertificateShown, now: float) -> list[Output]:
        assert self._decide is not None
        try:
            return self.admit(shown, self._decide(shown.key, shown.certificate, now), now)
        except Drop as drop:
            return [self.refuse_certificate(shown, drop)]
