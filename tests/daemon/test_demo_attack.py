"""``uavlinkd demo --attack`` as a person starts it."""

from __future__ import annotations

import asyncio
import json
import os
from pathlib import Path

import pytest

from tests.daemon.test_demo import ENDED_S, demo


async def test_an_attack_is_shown_and_nothing_false_comes_out(tmp_path: Path) -> None:
    """The summary says how often it struck and what the drones counted; status 0 although frames were lost."""
    async with demo("--attack", "alter-frame,share=0.5", "--seconds", "3", "--json", folder=tmp_path) as process:
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
    assert os.listdir(tmp_path) == [], "nothing is left behind"


async def test_a_screen_for_people_ends_with_the_verdict(tmp_path: Path) -> None:
    """And with a row for the attack."""
    async with demo("--attack", "replay-data", "--seconds", "2", folder=tmp_path) as process:
        out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert (process.returncode, err) == (0, b"")
    assert "Nothing forged, altered or sent again came out" in out.decode()
    assert "replayed" in out.decode()


async def test_an_attack_that_only_drops_is_noticed_too(tmp_path: Path) -> None:
    """No datagram is to blame, and yet the drones count what is missing."""
    async with demo("--attack", "drop,share=0.5", "--seconds", "5", "--json", folder=tmp_path) as process:
        out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert (process.returncode, err) == (0, b"")
    (attack,) = json.loads(out.splitlines()[-1])["attacks"]
    assert attack["noticed"]["envelopes_missing"] > 10


async def test_an_attack_that_never_strikes_fails_the_demo(tmp_path: Path) -> None:
    """Nothing was shown then."""
    async with demo("--attack", "replay-cookie,skip=1000", "--seconds", "1", "--json", folder=tmp_path) as process:
        out, _ = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert process.returncode == 1
    assert json.loads(out.splitlines()[-1])["attacks"][0]["interventions"] == 0


@pytest.mark.parametrize("attack", ["nonsense", "bit-flip,size=3", "misroute"])
async def test_an_attack_that_there_is_not_is_refused(tmp_path: Path, attack: str) -> None:
    """Also one that takes three drones; status 2, nothing started."""
    async with demo("--attack", attack, "--json", folder=tmp_path) as process:
        out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert (process.returncode, out) == (2, b"")
        assert b"Traceback" not in err
