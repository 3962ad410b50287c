"""``uavlinkd demo --attack`` as a person starts it."""

from __future__ import annotations

import asyncio
import json
import os
from pathlib import Path

import pytest

from tests.daemon.test_demo import ENDED_S, demo


async def test_an_attack_is_shown_and_nothing_false_comes_out(short_folder: Path) -> None:
    """The summary says how often it struck and what the drones counted; status 0 although frames were lost."""
    async with demo("--attack", "alter-frame,share=0.5", "--seconds", "3", "--json", folder=short_folder) as process:
        out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert (process.returncode, err) == (0, b"")
    summary = json.loads(out.splitlines()[-1])
    (attack,) = summary["attacks"]
    assert attack["name"] == "alter-frame,share=0.5"
    assert attack["interventions"] > 10
    assert attack["noticed"]["bad_tag"] > 0
    assert summary["frames_altered"] == 0
    assert 0 < summary["frames_delivered"] < summary["frames_sent"]
    assert summary["is_recovered"] is True
    assert os.listdir(short_folder) == [], "nothing is left"


async def test_a_screen_for_people_ends_with_the_verdict(short_folder: Path) -> None:
    """And with a row for the attack."""
    async with demo("--attack", "replay-data", "--seconds", "2", folder=short_folder) as process:
        out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert (process.returncode, err) == (0, b"")
    assert "No forged, altered or replayed frame was delivered" in out.decode()
    assert "replayed" in out.decode()


@pytest.mark.long
async def test_an_attack_that_only_drops_is_noticed_too(short_folder: Path) -> None:
    """No datagram is to blame, and yet the drones count what is missing."""
    async with demo("--attack", "drop,share=0.5", "--seconds", "12", "--json", folder=short_folder) as process:
        out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert (process.returncode, err) == (0, b"")
    (attack,) = json.loads(out.splitlines()[-1])["attacks"]
    assert attack["noticed"]["envelopes_missing"] > 10


async def test_an_attack_that_never_strikes_fails_the_demo(short_folder: Path) -> None:
    """The demo has shown nothing."""
    async with demo(
        "--attack", "replay-cookie,skip=1000", "--seconds", "1", "--json", folder=short_folder
    ) as process:
        out, _ = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert process.returncode == 1
    assert json.loads(out.splitlines()[-1])["attacks"][0]["interventions"] == 0
