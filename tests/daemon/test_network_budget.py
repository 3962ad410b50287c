"""A network with a budget, between two real daemons on addresses of the loopback interface."""

from __future__ import annotations

from pymavlink.dialects.v20 import all as mavlink

from tests.daemon.harness import Stage

SLOW_BITS_S = 8000


def attitude(number: int) -> bytes:
    """A state: the newest replaces the others."""
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    return bytes(mavlink.MAVLink_attitude_message(number, 1.5, 0.5, 0.25, 0.1, 0.1, 0.1).pack(codec))


async def test_frames_wait_for_the_budget_of_the_only_network(stage: Stage) -> None:
    """A flood of states is thinned, and the other daemon has the newest one at last."""
    a, b = stage.pair()
    a.config["listen"] = [f"0.0.0.0:{a.address.rpartition(':')[2]}"]
    a.config["network"] = [{"name": "modem", "address": "127.0.0.1", "budget_bits_s": SLOW_BITS_S}]
    into, _ = a.add_endpoint("autopilot"), b.add_endpoint("autopilot")
    ground = await stage.client()
    b.add_endpoint("ground", f"udpout:{ground}")
    await stage.start(a, b)
    autopilot = await stage.client()
    for number in range(400):
        autopilot.send(attitude(number), into)
    await a.until(lambda status: status["peers"]["drone1"]["waiting_dropped"].get("thinned", 0) > 200)
    autopilot.send(attitude(1_000), into)
    await ground.until(lambda: attitude(1_000) in ground.received)
    sent = (await a.status())["peers"]["drone1"]["bytes_sent"]
    assert sent < 400 * len(attitude(0)) / 2
