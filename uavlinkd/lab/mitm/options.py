"""The parameters of attacks: one model with all of them, from which each attack takes some."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import Any, Literal, cast

from pydantic import BaseModel, ConfigDict, Field, create_model

from uavlinkd.lab.mitm.anatomy import KINDS, KindFilter

STRANGERS = 256
"""Addresses of the attacker, numbered from 0. To a peer, each is an unknown sender."""


class Options(BaseModel):
    """All parameters. An attack takes the first ones, :data:`COMMON`, and those that its class names."""

    model_config = ConfigDict(extra="forbid", frozen=True, hide_input_in_errors=True, allow_inf_nan=False)

    begin_s: float = Field(0.0, ge=0, description="seconds before the attack begins")
    seconds: float | None = Field(None, gt=0, description="duration of the attack in seconds")
    direction: str = Field("both", description="both, or one direction: A>B; of one path: both/2, A>B/2")
    share: float = Field(1.0, gt=0, le=1, description="share of the matching datagrams that are attacked")
    limit: int | None = Field(None, ge=1, description="maximum number of attacked datagrams")
    kinds: KindFilter = Field("any", description=KINDS)
    block_handshakes: bool = Field(True, description="drop the handshake messages of both directions")
    back: Literal["echoes", "all"] = Field("echoes", description="what is dropped in the other direction")
    message: Literal["handshake", "initiation", "response", "confirmation", "cookie"] = Field(
        "handshake", description="initiation, response, handshake for both, confirmation (the first envelope), cookie"
    )
    beside: bool = Field(False, description="also pass the genuine datagram, after the altered one")
    repair_mac1: bool = Field(True, description="compute a valid mac1, if the receiver's public key is known")
    mac: Literal["mac1", "mac2"] = Field("mac1", description="the altered MAC")
    field: Literal["sender", "receiver", "both"] = Field(
        "both", description="the altered index; initiations have no receiver index"
    )
    to: Literal["random", "last", "ahead", "back"] = Field(
        "random", description="any counter, the last valid one (2^32-2), a little ahead, or a used one"
    )
    message_id: int = Field(0, ge=0, lt=2**24, description="MAVLink message: 0 HEARTBEAT, 77 COMMAND_ACK")
    size: int = Field(
        42, ge=0, description="an encrypted envelope of this length, or this plus 2, counts as this message"
    )
    rate_per_s: float = Field(10.0, gt=0, le=100_000, description="datagrams per second")
    mac1: Literal["valid", "bad"] = Field("valid", description="valid needs the receiver's public key")
    certificate: bool = Field(False, description="make initiations as long as those with a certificate")
    sources: int = Field(
        64, ge=0, le=STRANGERS, description="number of strangers that send; 0: send from the other peer's address"
    )
    origin: Literal["sender", "stranger", "both"] = Field(
        "both", description="source: a peer's address, strangers, or both in turn"
    )
    when: Literal["now", "later", "rekey", "restart"] = Field(
        "now",
        description="now; later: after delay_s; rekey: after the next handshake; restart: after a peer was silent"
        " and then initiates",
    )
    delay_s: float = Field(10.0, ge=0, description="for when=later: seconds until the replay")
    copies: int = Field(1, ge=1, le=1000, description="number of copies of each datagram")
    onto: int = Field(0, ge=0, description="number of the path along which they are sent; 0: the same one")
    hold_s: float = Field(30.0, gt=0, description="seconds until the release")
    at_once: bool = Field(False, description="release all together, hold_s after the first was held")
    interval_s: float = Field(1.8, gt=0, description="seconds between two envelopes")
    mode: Literal["race", "instead", "relay"] = Field(
        "race",
        description="race: from a stranger first, then from the genuine address; instead: only from the stranger;"
        " relay: only from the stranger, and the answers are relayed to the sender",
    )


COMMON = ("begin_s", "seconds", "direction", "share", "limit")


def options_with(takes: Mapping[str, Any]) -> type[Options]:
    """The model with the common parameters and these ones, which have these defaults."""
    fields: dict[str, Any] = {}
    for name in (*(one for one in takes if one not in COMMON), *COMMON):
        info = copy(Options.model_fields[name])
        info.default = takes.get(name, info.default)
        fields[name] = info.annotation, info
    return cast("type[Options]", create_model("Options", __config__=Options.model_config, **fields))


def describe_options(model: type[Options]) -> list[tuple[str, Any, str]]:
    """Name, default and description of each parameter. The common ones come last."""
    return [(name, info.default, info.description or "") for name, info in model.model_fields.items()]
