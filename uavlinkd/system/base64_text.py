"""Bytes as text in base64, with one spelling for each."""

from __future__ import annotations

from base64 import b64decode, b64encode


def to_base64(data: bytes) -> str:
    return b64encode(data).decode("ascii")


def from_base64(text: str) -> bytes:
    """The bytes in a text.

    Python's decoder also accepts unused bits at the end, and then two texts would stand for the same bytes.
    Raises ValueError if it is not what :func:`to_base64` returns.
    """
    data = b64decode(text, validate=True)
    if to_base64(data) != text:
        raise ValueError("has unused bits")
    return data
