"""Several programs on one local endpoint."""

from __future__ import annotations

from tests.daemon.harness import Stage, frame, heartbeat


async def test_every_program_on_an_endpoint_gets_what_comes(stage: Stage) -> None:
    """Three ground stations on one ``udpin`` all hear the vehicle, and the vehicle hears each of them."""
    a, b = stage.pair()
    vehicle = await stage.program()
    a.add_endpoint("autopilot", f"udpout:{vehicle}")
    into = b.add_endpoint("ground")
    await stage.start(a, b)
    stations = [await stage.program() for _ in range(3)]
    for number, station in enumerate(stations):
        station.send(heartbeat(250 + number), into)
        await vehicle.until_heard(heartbeat(250 + number))
    vehicle.send(frame(1), ("127.0.0.1", vehicle.sources[-1][1]))
    for station in stations:
        await station.until_heard(frame(1))
    programs = (await b.status())["endpoints"]["ground"]["programs"]
    assert sorted(programs) == sorted(map(str, stations))


async def test_programs_of_one_daemon_hear_each_other(stage: Stage) -> None:
    """What one local program says reaches the other ones too, and does not come back to itself."""
    a, b = stage.pair()
    into = a.add_endpoint("autopilot")
    await stage.start(a, b)
    one, other = await stage.program(), await stage.program()
    one.send(heartbeat(1), into)
    await a.until(lambda status: len(status["endpoints"]["autopilot"]["programs"]) == 1)
    other.send(heartbeat(2), into)
    await one.until(lambda: one.received == heartbeat(2))
    one.send(frame(1), into)
    await other.until(lambda: other.received == frame(1))
    assert one.received == heartbeat(2)


async def test_an_autopilot_that_comes_back_from_another_port_is_followed(stage: Stage) -> None:
    """After its restart an autopilot speaks from a new port, and gets there what the ground sends at once."""
    a, b = stage.pair()
    into = a.add_endpoint("autopilot")
    ground = await stage.program()
    b.add_endpoint("ground", f"udpout:{ground}")
    await stage.start(a, b)
    before = await stage.program()
    before.send(heartbeat(1), into)
    await ground.until_heard(heartbeat(1))
    before.close()
    after = await stage.program()
    after.send(frame(1), into)
    await ground.until_heard(frame(1))
    ground.send(frame(2, system=255), ("127.0.0.1", ground.sources[-1][1]))
    await after.until_heard(frame(2, system=255))


async def test_a_program_that_is_not_there_yet_harms_nobody(stage: Stage) -> None:
    """Of two ``udpout`` endpoints one leads to a port where nobody listens: the other gets everything."""
    a, b = stage.pair()
    into = a.add_endpoint("autopilot")
    absent, present = await stage.program(), await stage.program()
    b.add_endpoint("absent", f"udpout:{absent}")
    b.add_endpoint("present", f"udpout:{present}")
    absent.close()
    await stage.start(a, b)
    autopilot = await stage.program()
    expected = b""
    for number in range(20):
        autopilot.send(frame(number), into)
        expected += frame(number)
        await present.until(lambda: len(present.received) >= len(expected))  # noqa: B023  awaited at once
    assert present.received == expected
