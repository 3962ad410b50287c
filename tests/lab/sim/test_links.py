"""The simulator's own links: real sockets on loopback."""

from __future__ import annotations

from tests.lab.sim.recorded import Collector, frames


async def test_frames_pass_unchanged_in_both_directions() -> None:
    """What one end sends, the other collects byte for byte; a listener answers who called."""
    sent, answers = frames(20), frames(20, system_id=255)
    async with Collector("udpin:127.0.0.1:0") as ground:
        assert not ground.send(answers[0])
        async with Collector(f"udpout:127.0.0.1:{ground.address[1]}") as air:
            for frame in sent:
                assert air.send(frame)
            await ground.until(lambda: len(ground.frames) == len(sent))
            for frame in answers:
                assert ground.send(frame)
            await air.until(lambda: len(air.frames) == len(answers))
            assert (ground.frames, air.frames) == (sent, answers)
