"""The facts about the machine and its processes."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from uavlinkd.lab.evaluation import machine
from uavlinkd.lab.evaluation.machine import CpuTimeError, EnergyMeter, cpu_seconds, machine_facts


def test_the_facts_name_processor_and_versions() -> None:
    """A reader can tell on what the numbers were made."""
    facts = machine_facts()
    assert facts["cores"] == os.cpu_count()
    assert str(facts["openssl"]).startswith("OpenSSL")
    for name in ("cpu", "system", "python", "uavlinkd", "cryptography"):
        assert facts[name]


def test_processor_time_is_that_of_the_process() -> None:
    """It grows by what the process itself counts, and not by the time that it sleeps."""
    before, own_before = cpu_seconds(os.getpid()), time.process_time()
    while time.process_time() - own_before < 0.05:
        pass
    grown, own = cpu_seconds(os.getpid()) - before, time.process_time() - own_before
    assert grown == pytest.approx(own, abs=0.03)


def test_processor_time_without_the_schedulers_accounts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the kernel keeps no schedstat, stat is read: the same time in steps of 10 ms."""
    fine = cpu_seconds(os.getpid())
    monkeypatch.setattr(Path, "iterdir", lambda _: iter([Path("/nonexistent")]))
    assert cpu_seconds(os.getpid()) == pytest.approx(fine, abs=0.1, rel=0.05)


def test_a_process_that_has_ended_has_no_processor_time() -> None:
    """An error that can be recorded, not a zero that looks like a measurement."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    with pytest.raises(CpuTimeError):
        cpu_seconds(process.pid)


def zone(folder: Path, number: str, name: str, energy: int, most: int = 1_000_000) -> Path:
    """A zone as the kernel shows it."""
    path = folder / f"intel-rapl:{number}"
    path.mkdir()
    (path / "name").write_text(f"{name}\n")
    (path / "energy_uj").write_text(f"{energy}\n")
    (path / "max_energy_range_uj").write_text(f"{most}\n")
    return path


def test_energy_is_summed_over_packages_alone(tmp_path: Path) -> None:
    """A part of a package is in the package's counter already, and each package in that of the platform."""
    names = {"0": "package-0", "0:0": "core", "1": "package-1", "2": "psys"}
    zones = [zone(tmp_path, number, name, 100) for number, name in names.items()]
    meter = EnergyMeter(tmp_path)
    meter.start()
    for item in zones:
        (item / "energy_uj").write_text("500100\n")
    assert meter.joules() == pytest.approx(1.0)


def test_an_energy_counter_may_go_round(tmp_path: Path) -> None:
    """A counter that is smaller afterwards has passed its greatest value once."""
    package = zone(tmp_path, "0", "package-0", 900_000)
    meter = EnergyMeter(tmp_path)
    meter.start()
    (package / "energy_uj").write_text("99999\n")
    assert meter.joules() == pytest.approx(0.2)


def test_a_machine_that_does_not_tell_gives_no_joules(tmp_path: Path) -> None:
    """The result is None, never zero."""
    meter = EnergyMeter(tmp_path)
    meter.start()
    assert meter.joules() is None


def test_the_processor_has_a_name_on_boards_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """A Raspberry Pi has no "model name" for its board, but a "Model"."""
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: "processor : 0\nModel : Raspberry Pi 4 Model B\n")
    assert machine._cpu_name() == "Raspberry Pi 4 Model B"
