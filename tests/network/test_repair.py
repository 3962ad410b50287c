"""A mission and parameters over one path that loses 30 % of the datagrams in each direction."""

from __future__ import annotations

import pytest

from tests.network.repair import RADIOS, mission, parameters

LOSSY = ("30 % loss", "30 % in bursts of 3", "30 % in bursts of 5")
SEEDS = (1, 2)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", LOSSY)
def test_mission_is_up_within_15_s(name: str, seed: int) -> None:
    """100 items. Without repair it takes about 100 s."""
    assert mission(RADIOS[name], seed).seconds <= 15.0


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", LOSSY)
def test_parameters_are_read_within_20_s(name: str, seed: int) -> None:
    """1,370 parameters: the list, then the missing ones. Without repair it takes about 150 s."""
    assert parameters(RADIOS[name], seed).seconds <= 20.0


def test_clean_path_has_no_repeats() -> None:
    """Repair costs nothing where nothing is lost."""
    transfer = mission(RADIOS["clean"], 1)
    assert (transfer.repeats, transfer.repeat_bytes) == (0, 0)
    assert transfer.seconds < 3.0


def test_mission_without_repair_is_slow() -> None:
    """So the limits above are due to repair."""
    assert mission(RADIOS["30 % loss"], 1, has_repair=False).seconds > 45.0
