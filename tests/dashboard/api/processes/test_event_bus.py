"""The event_bus: late and slow clients catch up, and nothing is dropped in silence."""

import asyncio

from dashboard.api.processes.event_bus import BusEvent, EventBus


def read(event_bus: EventBus, after: int, campaign: str = "") -> list[BusEvent]:
    """What a client reads that comes after the end."""
    event_bus.close()

    async def all_of_it() -> list[BusEvent]:
        return [event async for event in event_bus.follow(after, campaign)]

    return asyncio.run(all_of_it())


def test_a_late_client_gets_what_it_has_missed() -> None:
    event_bus = EventBus()
    for number in range(200):
        event_bus.publish("run", str(number))
    assert [event.data for event in read(event_bus, 150)] == [str(number) for number in range(150, 200)]


def test_what_is_gone_is_counted_and_told() -> None:
    event_bus = EventBus(kept=10)
    for number in range(30):
        event_bus.publish("run", str(number))
    lost, *rest = read(event_bus, 5)
    assert (lost.kind, lost.data, lost.number) == ("lost", '{"events": 15}', 20)
    assert [event.data for event in rest] == [str(number) for number in range(20, 30)]
    assert event_bus.dropped == 15


def test_a_client_hears_of_its_campaign_alone() -> None:
    event_bus = EventBus()
    event_bus.publish("run", "1", campaign="a-1")
    event_bus.publish("run", "2", campaign="b-2")
    assert [event.data for event in read(event_bus, 0, "b-2")] == ["2"]


def test_only_the_newest_of_a_key_is_kept_for_late_clients() -> None:
    event_bus = EventBus()
    for number in range(3):
        event_bus.publish("flight", str(number), "a-1", key="flight 1")
    event_bus.publish("campaign", "c", "a-1", key="campaign a-1")
    assert [event.data for event in event_bus.newest("a-1")] == ["2", "c"]
    event_bus.forget("flight 1")
    assert [event.data for event in event_bus.newest()] == ["c"]
    assert event_bus.newest("b-2") == []


def test_a_place_in_another_life_is_no_place() -> None:
    event_bus = EventBus()
    event_bus.publish("run", "1")
    assert event_bus.place(event_bus.identity(1)) == 1
    assert event_bus.place(event_bus.identity(99)) == 1
    for other in (
        None,
        "",
        "1",
        "other.1",
        f"{event_bus.life}.",
        f"{event_bus.life}.x",
        f"{event_bus.life}.{'9' * 30}",
    ):
        assert event_bus.place(other) is None


def test_a_client_that_never_reads_keeps_nobody_waiting() -> None:
    async def watch() -> list[str]:
        event_bus = EventBus(kept=10)
        event_bus.bind(asyncio.get_running_loop())
        asleep = event_bus.follow(0)
        event_bus.publish("run", "first")
        await anext(asleep)  # and never again
        awake, heard = event_bus.follow(event_bus.last), []

        async def listen() -> None:
            async for event in awake:
                heard.append(event.data)  # noqa: PERF401 - heard as it comes

        listening = asyncio.create_task(listen())
        await asyncio.sleep(0)
        for number in range(5):
            await asyncio.to_thread(event_bus.publish, "run", str(number))
        event_bus.close()
        await listening
        return heard

    assert asyncio.run(watch()) == ["0", "1", "2", "3", "4"]
