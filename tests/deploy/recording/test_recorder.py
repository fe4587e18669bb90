"""The recorder tells a flight by its messages, in whatever order they arrived."""

from deploy.recording.recorder import Divergence, FlightRecorder, FlightTrace
from services.bus.horizon import NEVER_NS, Promise, Stamped
from services.bus.topics import RECORDED, STAGES, published_by


def promise(serial: int, counts: list[int], until_ns: int) -> bytes:
    return Promise(serial, 0, 0, (until_ns,) * len(counts), tuple(counts)).packed()


def flight(order: list[int], payload_of_2: bytes = b"c") -> FlightRecorder:
    recorder = FlightRecorder()
    payloads = [b"a", b"b", payload_of_2, b"d"]
    for seq in order:
        recorder.record("command", Stamped(seq, 40 * seq, payloads[seq]))
    return recorder


def test_the_digest_does_not_depend_on_the_order_of_arrival() -> None:
    assert flight([0, 1, 2, 3]).trace(1000).digest() == flight([3, 1, 0, 2]).trace(1000).digest()


def test_one_changed_byte_changes_the_digest_and_is_found() -> None:
    golden, faulty = flight([0, 1, 2, 3]).trace(1000), flight([0, 1, 2, 3], b"x").trace(1000)
    assert golden.digest() != faulty.digest()
    assert faulty.report("command", golden).diverged_at_s == 80e-9
    assert faulty.report("odometry", golden).diverged_at_s is None


def test_what_is_ready_after_the_end_does_not_count() -> None:
    assert flight([0, 1, 2]).trace(80).digest() == flight([0, 1, 2, 3]).trace(80).digest()


def test_a_flight_that_ends_earlier_diverges_where_its_twin_goes_on() -> None:
    one, two = FlightTrace({"x": [0]}, {"x": [b"a"]}), FlightTrace({"x": [0, 40]}, {"x": [b"a", b"b"]})
    assert one.divergence("x", two) == two.divergence("x", one) == Divergence(1, 40)
    assert one.divergence("x", one) is None


def test_complete_means_that_every_topic_is_silent_beyond_the_end() -> None:
    recorder = FlightRecorder()
    for serial, stage in enumerate(STAGES, 1):
        assert not recorder.complete(100)
        recorder.hear(stage, promise(serial, [0] * len(published_by(stage)), NEVER_NS))
    assert recorder.complete(100)


def test_a_promise_about_a_missing_message_completes_nothing() -> None:
    recorder = FlightRecorder()
    for stage in STAGES:
        counts = [int(topic.name == "command") for topic in published_by(stage)]
        recorder.hear(stage, promise(1, counts, NEVER_NS))
    assert not recorder.complete(100)
    recorder.record("command", Stamped(0, 40, b"late"))
    assert recorder.complete(100)


def test_a_new_life_begins_after_all_that_the_old_one_said() -> None:
    recorder = FlightRecorder()
    recorder.hear("control", promise(1, [0], 70))
    recorder.record("command", Stamped(0, 90, b""))
    assert recorder.silent_until_ns("control") == 90


def test_a_new_life_is_given_the_last_latched_message_and_no_older_stream() -> None:
    recorder = FlightRecorder()
    for seq in range(3):
        recorder.record("trajectory", Stamped(seq, 100 * seq, b""))
        recorder.record("odometry", Stamped(seq, 100 * seq, b""))
    resume = recorder.resume_from(150)
    assert resume["trajectory"] == 1
    assert resume["odometry"] == 2
    assert set(resume) == {topic.name for topic in RECORDED}


def test_a_message_that_is_ready_at_another_time_changes_the_digest_and_is_found() -> None:
    golden, later = FlightRecorder(), FlightRecorder()
    for seq in range(3):
        golden.record("command", Stamped(seq, 40 * seq, b"same"))
        later.record("command", Stamped(seq, 40 * seq + (seq == 1), b"same"))
    assert golden.trace(1000).digest() != later.trace(1000).digest()
    assert later.trace(1000).report("command", golden.trace(1000)).diverged_at_s == 40e-9
    assert later.trace(1000).divergence("command", golden.trace(1000)) == Divergence(1, 40)


def test_the_same_message_on_another_topic_is_another_flight() -> None:
    one, other = FlightRecorder(), FlightRecorder()
    one.record("command", Stamped(0, 40, b"same"))
    other.record("odometry", Stamped(0, 40, b"same"))
    assert one.trace(1000).digest() != other.trace(1000).digest()


def test_what_is_ready_just_at_the_end_counts() -> None:
    assert len(flight([0, 1, 2, 3]).until(80)["command"]) == 3
    assert len(flight([0, 1, 2, 3]).until(79)["command"]) == 2


def test_a_promise_until_the_end_does_not_complete_the_end_itself() -> None:
    recorder = FlightRecorder()
    for stage in STAGES:
        recorder.hear(stage, promise(1, [0] * len(published_by(stage)), 100))
    assert recorder.complete(99)
    assert not recorder.complete(100)


def test_the_flight_is_recorded_as_far_as_its_slowest_topic() -> None:
    recorder = FlightRecorder()
    for number, stage in enumerate(STAGES):
        recorder.hear(stage, promise(1, [0] * len(published_by(stage)), 100 + number))
    assert recorder.horizon_ns == 100


def test_a_new_life_is_given_the_message_of_its_first_moment() -> None:
    recorder = FlightRecorder()
    for seq in range(3):
        recorder.record("odometry", Stamped(seq, 100 * seq, b""))
    assert recorder.resume_from(100)["odometry"] == 1
    assert recorder.resume_from(101)["odometry"] == 2


def test_a_late_node_is_told_the_newest_promise_whatever_came_last() -> None:
    recorder = FlightRecorder()
    newest, older = promise(2, [0], 70), promise(1, [0], 30)
    recorder.hear("control", newest)
    recorder.hear("control", older)
    assert recorder.horizon("control") == newest


def test_what_could_not_be_kept_is_counted() -> None:
    recorder = flight([0, 1])
    recorder.record("command", Stamped(1, 40, b"again"))
    recorder.hear("control", b"nonsense")
    assert recorder.refused == 2


def test_who_missed_a_message_is_given_it_and_all_that_followed() -> None:
    assert [message.seq for message in flight([0, 1, 2, 3]).since("command", 1)] == [1, 2, 3]
