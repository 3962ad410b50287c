"""Policies for tests that are about something else."""

from __future__ import annotations

from types import MappingProxyType

from uavlinkd.config.model import PolicyData

TRUSTED: PolicyData = MappingProxyType({"role": "all", "system_ids": "all"})
"""Of a peer that may say everything."""
