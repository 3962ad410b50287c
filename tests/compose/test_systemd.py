"""The service under a real systemd: two daemons as instances of uavlinkd@, with all of the hardening."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.compose import images
from tests.compose.machine import Machine, build
from tests.needs import need

WATCHDOG_S = 6.0

_CONFIGURE = """
uavlinkd=/opt/uavlinkd/bin/uavlinkd
umask 077
for name in a b; do
    mkdir -p /etc/uavlinkd/$name
    $uavlinkd keygen --out /etc/uavlinkd/$name/$name.key >/tmp/$name.pub
done
umask 022
configure() {
    cat >/etc/uavlinkd/$1.toml <<END
name = "$1"
private_key_file = "$1.key"
listen = ["$3"]
control_socket = "/run/uavlinkd/$1/control.sock"
[[endpoint]]
name = "autopilot"
url = "udpin:127.0.0.1:$5"
[[peer]]
name = "$2"
public_key = "$(cat /tmp/$2.pub)"
addresses = ["$4"]
role = "swarm-member"
system_ids = [1, 2]
END
}
# "b" listens at an address that no interface has yet.
configure a b 127.0.0.1:5790 192.0.2.1:5790 14550
configure b a 192.0.2.1:5790 127.0.0.1:5790 14551
chmod 0755 /etc/uavlinkd
"""


@pytest.fixture(scope="module")
def machine() -> Iterator[Machine]:
    """One for all tests of this file, with both daemons linked."""
    why = images.why_not()
    need(why is None, str(why))
    with Machine(build()) as machine:
        machine.say(_CONFIGURE)
        machine.say("systemctl start uavlinkd@a uavlinkd@b")
        assert machine.show("uavlinkd@b", "StatusText") in ("", "0 of 1 peers up")
        machine.add_address("192.0.2.1/32")
        machine.until(lambda: is_linked(machine))
        yield machine


def is_linked(machine: Machine) -> bool:
    """Whether both say so to systemd, and run."""
    return all(
        (facts["ActiveState"], facts["StatusText"]) == ("active", "1 of 1 peers up")
        for facts in (machine.facts(f"uavlinkd@{instance}") for instance in "ab")
    )


def is_back(machine: Machine, before: str, unit: str = "uavlinkd@a") -> bool:
    """Whether a unit runs again, as another process."""
    facts = machine.facts(unit)
    return facts["ActiveState"] == "active" and facts["MainPID"] not in ("0", before)


def test_keys_come_from_systemd_to_a_user_without_a_name_of_its_own(machine: Machine) -> None:
    """Neither daemon reads the keys in /etc, and neither sees the other's."""
    for name, other in ("ab", "ba"):
        pid = machine.show(f"uavlinkd@{name}", "MainPID")
        status = machine.say(f"cat /proc/{pid}/status")
        fields = dict(line.split(":\t", 1) for line in status.splitlines() if ":\t" in line)
        assert int(fields["Uid"].split()[0]) >= 61184  # systemd's range for users of the moment
        assert fields["CapEff"] == fields["CapBnd"] == "0" * 16
        assert (fields["NoNewPrivs"], fields["Seccomp"]) == ("1", "2")
        names = machine.say(f"nsenter --target {pid} --mount ls /run/credentials/uavlinkd@{name}.service").split()
        assert names == [f"keys_{name}.key"]
        assert machine.say("stat --format=%a:%U /etc/uavlinkd/a /etc/uavlinkd/b").split() == ["700:root"] * 2
        assert other not in names


def test_status_is_for_root_alone(machine: Machine) -> None:
    """In the folder that systemd made."""
    status = "/opt/uavlinkd/bin/uavlinkd status --socket /run/uavlinkd/a/control.sock"
    assert "1 of 1 peers up" in machine.say(status)
    assert machine.run(f"setpriv --reuid=nobody --clear-groups {status}").returncode == 1


def test_a_stopped_loop_is_restarted(machine: Machine) -> None:
    """The watchdog notices that the loop does not turn, and the link is back soon."""
    before = machine.show("uavlinkd@a", "MainPID")
    machine.say(f"kill -STOP {before}")
    took_s = machine.until(lambda: is_back(machine, before))
    print(f"running again {took_s:.1f} s after its loop stood still")
    assert took_s > WATCHDOG_S / 2 - 1
    assert "Failed with result 'watchdog'" in machine.say("journalctl --no-pager --unit=uavlinkd@a --output=cat")
    machine.until(lambda: is_linked(machine))


def test_a_killed_daemon_is_restarted_each_time(machine: Machine) -> None:
    """More often in a row than systemd's own limit would let it."""
    for _ in range(6):
        before = machine.show("uavlinkd@a", "MainPID")
        machine.say(f"kill -KILL {before}")
        machine.until(lambda before=before: is_back(machine, before))  # type: ignore[misc]
    machine.until(lambda: is_linked(machine))


def test_reload_works_and_an_invalid_file_is_refused(machine: Machine) -> None:
    """The same process goes on; the status says that a file was refused."""
    before = machine.show("uavlinkd@b", "MainPID")
    machine.say(
        "cp /etc/uavlinkd/b.toml /root/; echo 'colour = 1' >>/etc/uavlinkd/b.toml; systemctl reload uavlinkd@b"
    )
    machine.until(lambda: "refused" in machine.show("uavlinkd@b", "StatusText"))
    machine.say("cp /root/b.toml /etc/uavlinkd/; systemctl reload uavlinkd@b")
    machine.until(lambda: is_linked(machine))
    assert machine.show("uavlinkd@b", "MainPID") == before


def test_serial_port_of_the_group_is_opened(machine: Machine) -> None:
    """By its group, through the sandbox: a pseudo-terminal stands for the radio."""
    machine.say(
        "python3 - >/root/port 2>&1 <<'END' &\n"
        "import grp, os, pty, time\n"
        "ours, theirs = pty.openpty()\n"
        "name = os.ttyname(theirs)\n"
        "os.chown(name, 0, grp.getgrnam('dialout').gr_gid)\n"
        "os.chmod(name, 0o660)\n"
        "print(name, flush=True)\n"
        "time.sleep(120)\n"
        "END\n"
        "while ! grep -q /dev/pts /root/port; do sleep 0.05; done\n"
        "cp /etc/uavlinkd/a.toml /root/\n"
        """printf '[[endpoint]]\\nname = "radio"\\nurl = "serial:%s:57600"\\n' $(cat /root/port)"""
        " >>/etc/uavlinkd/a.toml\n"
        "systemctl restart uavlinkd@a"
    )
    port = machine.say("cat /root/port").strip()
    log = "journalctl --no-pager --unit=uavlinkd@a --output=cat"
    machine.until(lambda: f'"endpoint": "radio", "client": "{port}"' in machine.say(log))
    machine.say("cp /root/a.toml /etc/uavlinkd/; systemctl restart uavlinkd@a")
    machine.until(lambda: is_linked(machine))


def test_keys_may_be_encrypted(machine: Machine) -> None:
    """As the unit says: with the machine's own key, and the plain ones away."""
    machine.say(
        "systemd-creds setup 2>/dev/null\n"
        "mkdir -p /etc/uavlinkd/a.encrypted /etc/systemd/system/uavlinkd@a.service.d\n"
        "systemd-creds encrypt --name=keys_a.key /etc/uavlinkd/a/a.key /etc/uavlinkd/a.encrypted/a.key 2>/dev/null\n"
        "mv /etc/uavlinkd/a /root/away\n"
        "printf '[Service]\\nLoadCredential=\\nLoadCredentialEncrypted=keys:/etc/uavlinkd/a.encrypted\\n'"
        " >/etc/systemd/system/uavlinkd@a.service.d/keys.conf\n"
        "systemctl daemon-reload; systemctl restart uavlinkd@a"
    )
    machine.until(lambda: is_linked(machine))
    machine.say("mv /root/away /etc/uavlinkd/a; rm -r /etc/systemd/system/uavlinkd@a.service.d")
    machine.say("systemctl daemon-reload; systemctl restart uavlinkd@a")
    machine.until(lambda: is_linked(machine))


def test_the_end_is_clean(machine: Machine) -> None:
    """The peer is notified, the exit status is 0, and nothing is left in /run."""
    machine.say("systemctl stop uavlinkd@a")
    assert machine.show("uavlinkd@a", "Result") == "success"
    machine.until(lambda: machine.show("uavlinkd@b", "StatusText") == "0 of 1 peers up")
    assert machine.say("ls /run/uavlinkd").split() == ["b"]
    machine.say("systemctl start uavlinkd@a")
    machine.until(lambda: is_linked(machine))
