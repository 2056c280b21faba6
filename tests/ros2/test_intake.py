"""Which clouds are fused: the newest of each topic, once its transforms are there; all others are counted."""

import pytest

from torchelev.ros2.intake import Intake


def yes(_):
    return True


def no(_):
    return False


def fuse(intake, now=0.0, is_ready=yes):
    """Take what is ready and fuse it -> (message, dt) of each."""
    found = []
    for one in intake.take(now, is_ready)[0]:
        found.append((one.reading, intake.elapsed(one)))
        intake.note_fused(one, now)
    return found


def test_the_newest_cloud_of_a_topic_wins():
    intake = Intake(["a", "b"], wait=0.2)
    for k in range(5):
        intake.offer("a", k, 1 + 0.1 * k, now=0.1 * k)
    assert fuse(intake) == [(4, 0.0)] and fuse(intake) == []
    assert intake.counts.as_dict() | {"received": 0, "fused": 0, "replaced": 0} == dict.fromkeys(
        intake.counts.as_dict(), 0
    )
    assert (intake.counts.received, intake.counts.fused, intake.counts.replaced) == (5, 1, 4)


def test_topics_are_fused_in_the_order_of_their_stamps():
    intake = Intake(["a", "b"], wait=0.2)
    intake.offer("b", "later", 1.3, 0.0)
    intake.offer("a", "first", 1.0, 0.0)
    assert fuse(intake) == [("first", 0.0), ("later", pytest.approx(0.3))]


def test_a_cloud_waits_for_its_transforms_and_not_longer():
    intake = Intake(["a", "b"], wait=0.2)
    intake.offer("a", "early", 1.0, now=5.0)
    assert intake.take(5.1, no) == ([], []) and intake.is_waiting
    assert fuse(intake, 5.15) == [("early", 0.0)] and not intake.is_waiting
    intake.offer("a", "lost", 2.0, now=6.0)
    ready, lost = intake.take(6.3, no)
    assert ready == [] and [one.reading for one in lost] == ["lost"] and intake.counts.without_transform == 1
    assert intake.take(6.4, yes) == ([], [])


@pytest.mark.parametrize("lag", [0.05, 0.15])
def test_transforms_later_than_the_next_cloud_are_waited_for(lag):
    """Clouds every 0.1 s, whose transforms come later: each is fused, and none replaces one that still waits."""
    intake, found, lost = Intake(["a"], wait=0.2), [], []
    for k in range(100):
        now = 0.01 * k
        if k % 10 == 0:
            intake.offer("a", k, 10 + now, now)
        ready, out = intake.take(now, lambda one, now=now: one.stamp <= 10 + now - lag)
        lost += out
        for one in ready:
            intake.note_fused(one, now)
            found.append(one.reading)
    assert found == list(range(0, 100 - round(100 * lag), 10)) and lost == [] and intake.counts.replaced == 0


def test_transforms_that_never_come_are_said_for_each_cloud():
    intake, lost = Intake(["a"], wait=0.2), []
    for k in range(50):
        if k % 5 == 0:  # every 0.05 s
            intake.offer("a", k, 10 + 0.01 * k, 0.01 * k)
        lost += intake.take(0.01 * k, no)[1]
    assert len(lost) == 6 and intake.counts.without_transform == 6 and intake.counts.replaced == 0


def test_few_clouds_wait():
    intake = Intake(["a"], wait=10.0)
    for k in range(100):
        intake.offer("a", k, 1 + 0.001 * k, 0.001 * k)
    assert intake.counts.replaced == 68 and fuse(intake) == [(99, 0.0)] and intake.counts.replaced == 99


def test_repeated_and_late_clouds_are_counted():
    intake = Intake(["a", "b"], wait=0.2)
    intake.offer("a", 0, 10.0, 0.0)
    assert fuse(intake) == [(0, 0.0)]
    intake.offer("a", 0, 10.0, 0.1)
    assert fuse(intake) == [] and intake.counts.repeated == 1
    intake.offer("b", 1, 9.7, 0.2)
    assert fuse(intake) == [(1, 0.0)] and intake.counts.late == 1 and intake.stamp == 10.0
    intake.offer("a", 2, 10.5, 0.3)
    assert fuse(intake) == [(2, 0.5)]


def test_a_clock_that_jumps_back_starts_over():
    intake = Intake(["a", "b"], wait=0.2)
    intake.offer("a", 0, 100.0, 0.0)
    fuse(intake)
    assert not intake.offer("a", 1, 99.5, 0.1), "a late cloud is no jump"
    assert intake.offer("a", 2, 3.0, 0.2) and intake.counts.jumps == 1
    assert fuse(intake) == [(2, 0.0)] and intake.stamp == 3.0
    intake.offer("a", 3, 3.1, 0.3)
    assert fuse(intake) == [(3, pytest.approx(0.1))]


def test_a_jump_is_seen_before_anything_was_fused():
    intake = Intake(["a", "b"], wait=0.2)
    intake.offer("a", 0, 100.0, 0.0)
    assert intake.offer("a", 1, 3.0, 0.1) and intake.counts.replaced == 1
    assert fuse(intake) == [(1, 0.0)]


def test_clouds_without_a_stamp_are_left_out():
    intake = Intake(["a", "b"], wait=0.2)
    for stamp in (0.0, -1.0):
        assert not intake.offer("a", 0, stamp, 0.0)
    assert fuse(intake) == [] and intake.counts.without_stamp == 2


def test_a_cloud_that_the_map_refuses_leaves_its_time_to_the_next():
    intake = Intake(["a", "b"], wait=0.2)
    intake.offer("a", 0, 1.0, 0.0)
    fuse(intake)
    intake.offer("a", 1, 1.5, 0.1)
    intake.take(0.1, yes)  # and not fused
    intake.offer("a", 2, 2.0, 0.2)
    assert fuse(intake) == [(2, 1.0)] and intake.counts.fused == 2


def test_each_topic_that_stops_is_named():
    intake = Intake(["a", "b"], wait=0.2)
    nothing = "{}: nothing was received: check its name, and the parameter reliable against its QoS"
    assert intake.findings(0.0) == [nothing.format("a"), nothing.format("b")]
    intake.offer("a", 0, 1.0, 0.0)
    intake.take(1.0, no)
    first = "a: nothing was fused yet: check tf, stamps and the sensor; the node's log says more"
    assert intake.findings(1.0) == [first, nothing.format("b")]
    for topic in "ab":
        intake.offer(topic, 0, 2.0, 2.0)
    fuse(intake, now=2.0)
    assert intake.findings(3.9) == []
    intake.offer("b", 0, 6.0, 6.0)
    fuse(intake, now=6.0)
    (only,) = intake.findings(7.0)
    assert only.startswith("a: nothing was fused for 5 s")
