"""The hub: late and slow clients catch up, and nothing is dropped in silence."""

import asyncio

from dashboard.api.hub import Event, Hub


def read(hub: Hub, after: int, campaign: str = "") -> list[Event]:
    """What a client reads that comes after the end."""
    hub.close()

    async def all_of_it() -> list[Event]:
        return [event async for event in hub.follow(after, campaign)]

    return asyncio.run(all_of_it())


def test_a_late_client_gets_what_it_has_missed() -> None:
    hub = Hub()
    for number in range(200):
        hub.publish("run", str(number))
    assert [event.data for event in read(hub, 150)] == [str(number) for number in range(150, 200)]


def test_what_is_gone_is_counted_and_told() -> None:
    hub = Hub(kept=10)
    for number in range(30):
        hub.publish("run", str(number))
    lost, *rest = read(hub, 5)
    assert (lost.kind, lost.data, lost.number) == ("lost", '{"events": 15}', 20)
    assert [event.data for event in rest] == [str(number) for number in range(20, 30)]
    assert hub.dropped == 15


def test_a_client_hears_of_its_campaign_alone() -> None:
    hub = Hub()
    hub.publish("run", "1", campaign="a-1")
    hub.publish("run", "2", campaign="b-2")
    assert [event.data for event in read(hub, 0, "b-2")] == ["2"]


def test_only_the_newest_of_a_key_is_kept_for_late_clients() -> None:
    hub = Hub()
    for number in range(3):
        hub.publish("flight", str(number), "a-1", key="flight 1")
    hub.publish("campaign", "c", "a-1", key="campaign a-1")
    assert [event.data for event in hub.newest("a-1")] == ["2", "c"]
    hub.forget("flight 1")
    assert [event.data for event in hub.newest()] == ["c"]
    assert hub.newest("b-2") == []


def test_a_place_in_another_life_is_no_place() -> None:
    hub = Hub()
    hub.publish("run", "1")
    assert hub.place(hub.identity(1)) == 1
    assert hub.place(hub.identity(99)) == 1
    for other in (None, "", "1", "other.1", f"{hub.life}.", f"{hub.life}.x", f"{hub.life}.{'9' * 30}"):
        assert hub.place(other) is None


def test_a_client_that_never_reads_keeps_nobody_waiting() -> None:
    async def watch() -> list[str]:
        hub = Hub(kept=10)
        hub.bind(asyncio.get_running_loop())
        asleep = hub.follow(0)
        hub.publish("run", "first")
        await anext(asleep)  # and never again
        awake, heard = hub.follow(hub.last), []

        async def listen() -> None:
            async for event in awake:
                heard.append(event.data)  # noqa: PERF401 - heard as it comes

        listening = asyncio.create_task(listen())
        await asyncio.sleep(0)
        for number in range(5):
            await asyncio.to_thread(hub.publish, "run", str(number))
        hub.close()
        await listening
        return heard

    assert asyncio.run(watch()) == ["0", "1", "2", "3", "4"]
