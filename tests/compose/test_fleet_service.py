"""`fleet enroll --service` under a real systemd: files, units and the link, without another command there."""

from __future__ import annotations

import os
from pathlib import Path

import cryptography.hazmat.primitives.serialization  # noqa: F401  a module without a specification stays loaded
import pytest

from tests.compose import images
from tests.compose.machine import Machine, build
from tests.needs import need
from tests.waiting import Stopwatch
from uavlinkd.cli import main
from uavlinkd.system.terminal import FAILED, OK

_DROP_IN = "/etc/systemd/system/uavlinkd@v7.service.d"
_BROKEN = r"[Service]\nExecStart=\nExecStart=/opt/uavlinkd/bin/uavlinkd run --config /etc/uavlinkd/absent.toml\n"


def test_one_command_for_each_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A station, a relay and a vehicle on one machine, by root: the vehicle has a link when the command ends.

    Its autopilot is absent, and the command fails with that.
    """
    why = images.why_not()
    need(why is None, str(why))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    assert main(["fleet", "init", "--no-passphrase"]) == 0
    with Machine(build()) as machine:
        machine.stand_in_for_ssh(tmp_path)
        machine.say("rm /etc/systemd/system/uavlinkd*.service && systemctl daemon-reload")
        _enroll("relay --role relay --address 127.0.0.1:5789")
        _enroll("gs --role operator --address 127.0.0.1:5790")
        watch = Stopwatch()
        capsys.readouterr()
        _enroll("v7 --id 7 --url udpin:127.0.0.1:14551", FAILED)
        out, error = capsys.readouterr()
        assert "v7: autopilot: no client has sent MAVLink to udpin:127.0.0.1:14551 within" in error
        took_s = watch.elapsed_s
        assert "v7 has a link with gs" in out
        for unit in ("uavlinkd-relay", "uavlinkd@gs", "uavlinkd@v7"):
            assert machine.show(unit, "ActiveState") == "active"
            assert machine.show(unit, "UnitFileState") == "enabled"
            assert machine.show(unit, "NRestarts") == "0"
        before = machine.show("uavlinkd@v7", "MainPID")
        _enroll("v7 --id 7", FAILED)
        assert machine.show("uavlinkd@v7", "MainPID") != before
        machine.say(f"mkdir {_DROP_IN} && printf '{_BROKEN}' > {_DROP_IN}/broken.conf && systemctl daemon-reload")
        _enroll("v7", FAILED)
        assert "Its log ends with: /etc/uavlinkd/absent.toml: cannot be read" in capsys.readouterr().err
        machine.say("rm -r /etc/systemd/system/uavlinkd@* /opt/uavlinkd/lib/systemd && systemctl daemon-reload")
        assert main(["fleet", "enroll", "v8", "--service"]) == 1
        assert "Install uavlinkd there in /opt/uavlinkd, or its package" in capsys.readouterr().err
    print(f"a vehicle was enrolled, started and linked in {took_s:.1f} s:\n{out}")


def _enroll(words: str, status: int = OK) -> None:
    assert main(["fleet", "enroll", *words.split(), "--service"]) == status
