"""Messages that are damaged, too large or of somebody else are refused before anything of them is used."""

import json
import struct
import zlib

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from tests.site.service.walks import START, Network, Walker
from torchelev.io.errors import RecordingError
from torchelev.site.service import SiteServer
from torchelev.site.service.outbox import Outbox
from torchelev.site.service.questions import ask_areas, read_answer
from torchelev.site.service.wire import messages
from torchelev.site.service.wire.access import read_keys
from torchelev.site.service.wire.messages import MAX_MESSAGE, MessageError, decode, encode

LAYOUT = [("height", "float32", (3, 4)), ("mask", "bool", (3, 5)), ("corner", "int64", (2,)), ("now", "float64", ())]


def arrays():
    generator = np.random.default_rng(0)
    return {
        "height": generator.normal(size=(3, 4)).astype(np.float32),
        "mask": generator.random((3, 5)) < 0.5,
        "corner": np.array([-(1 << 35), 7]),
        "now": np.array(START),
    }


def windows_message():
    """Windows of a robot that was welcomed, and the network that it is in."""
    network = Network([Walker("a")])
    network.walk()
    outbox = network.outboxes["a"]
    network.server.handle(outbox.next_message(0.0), "a")
    for answer in network.server.step():
        outbox.receive(answer.payload, 0.0)
    return network, outbox.next_message(1.0)


def test_a_message_returns_every_bit():
    message = decode(encode({"kind": "test"}, LAYOUT, arrays(), b"key"))
    assert message.header["kind"] == "test" and message.is_signed_with(b"key") and not message.is_signed_with(b"kex")
    for name, value in message.arrays(LAYOUT).items():
        assert value.dtype == arrays()[name].dtype and np.array_equal(value, arrays()[name])


NETWORK, PAYLOAD = windows_message()


@pytest.mark.slow(2)
@given(st.integers(0, len(PAYLOAD) - 1), st.integers(1, 255))
def test_a_damaged_byte_never_raises_and_merges_nothing_else(place, difference):
    damaged = bytearray(PAYLOAD)
    damaged[place] ^= difference
    server = SiteServer(None, resolution=0.1, align=False, clock=lambda: START + 1e6)
    server.site._id = NETWORK.server.site.id
    server.handle(bytes(damaged), "a")
    server.step()
    header_ends = 42 + struct.unpack_from("<I", PAYLOAD, 38)[0]
    if place < 6 or place >= header_ends:  # the arrays have check sums; a key also covers the header
        assert server.counts["merged"] == 0 and server.counts["damaged"] + server.counts["refused"] == 1
    keyed = SiteServer(None, resolution=0.1, keys={"a": 16 * "k"}, clock=lambda: START + 1e6)
    keyed.handle(bytes(damaged), "a")
    keyed.step()
    assert keyed.counts["merged"] == 0


@pytest.mark.parametrize("size", [0, 3, 41, 42, 100, -1])
def test_a_part_of_a_message_is_damaged(size):
    server = SiteServer(None, clock=lambda: START + 1e6)
    server.site._id = NETWORK.server.site.id
    server.handle(PAYLOAD[:size], "a")
    assert not server.step() and server.counts["damaged"] == 1


def rewritten(change, replace=None):
    """The message with another header, or with another array in place of one."""
    length = struct.unpack_from("<I", PAYLOAD, 38)[0]
    header, body = json.loads(PAYLOAD[42 : 42 + length]), PAYLOAD[42 + length :]
    change(header)
    if replace is not None:
        number, part = replace
        start = sum(header["bytes"][:number])
        body = body[:start] + part + body[start + header["bytes"][number] :]
        header["bytes"][number] = len(part)
    text = json.dumps(header).encode()
    return PAYLOAD[:38] + struct.pack("<I", len(text)) + text + body


NAN = np.full((1, 40, 36), np.nan, np.float32).view(np.uint8).reshape(-1, 4).T.tobytes()
CHANGES = {
    "sizes": lambda: rewritten(lambda header: header.update(height=41)),
    "a huge window": lambda: rewritten(lambda header: header.update(height=4096, width=4096, windows=4096)),
    "no windows": lambda: rewritten(lambda header: header.update(windows=0)),
    "a negative length": lambda: rewritten(lambda header: header["bytes"].__setitem__(0, -1)),
    "a number as text": lambda: rewritten(lambda header: header.update(number="1")),
    "a number as bool": lambda: rewritten(lambda header: header.update(number=True)),
    "another robot": lambda: rewritten(lambda header: header.update(robot="a/../b")),
    "another kind": lambda: rewritten(lambda header: header.update(kind="merged")),
    "NaN": lambda: rewritten(lambda header: None, (0, zlib.compress(NAN))),
    "a bomb": lambda: rewritten(lambda header: None, (0, zlib.compress(bytes(1 << 28), 9))),
    "a deep header": lambda: PAYLOAD[:38] + struct.pack("<I", 100_000) + b"[" * 100_000,
    "not a message": lambda: b"\x80\x04cos\nsystem\n(S'true'\ntR." + bytes(100),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_no_robot_sends_is_refused(name):
    server = SiteServer(None, resolution=0.1, clock=lambda: START + 1e6)
    server.site._id = NETWORK.server.site.id
    server.handle(CHANGES[name](), "a")
    assert not server.step() and server.counts["damaged"] == 1 and len(server.site) == 0


def test_another_version_of_the_protocol_is_told():
    payload = PAYLOAD[:4] + struct.pack("<H", 2) + PAYLOAD[6:]
    server, outbox = SiteServer(None), Outbox("a", 0.1)
    server.handle(payload, "a")
    (answer,) = server.step()
    assert answer.robot == "a" and "must be of version 1, got 2" in decode(answer.payload).header["text"]
    outbox.receive(payload, 0.0)
    assert "must be of version 1, got 2" in str(outbox.error)


def test_windows_that_cannot_be_merged_do_not_stop_the_others(monkeypatch):
    network = Network([Walker("a"), Walker("b", y=1.0, seed=1)])
    merge = network.server.site.merge_received

    def fail(received, *arguments, **options):
        if len(received.offset) == 2 or float(received.windows.known.corner[0, 1]) < -15:
            raise RuntimeError("singular")
        return merge(received, *arguments, **options)

    monkeypatch.setattr(network.server.site, "merge_received", fail)
    network.walk()
    network.exchange()
    errors = [outbox.error for outbox in network.outboxes.values()]
    assert "cannot be merged (singular)" in str(errors[0]) and errors[1] is None
    assert network.server.counts["merged"] == 1


def test_more_than_fits_is_dropped_and_sent_again():
    network = Network([Walker("a"), Walker("b", y=1.0, seed=1)])
    network.walk()
    network.server._inbox._max_bytes = 1000
    network.exchange(3.0)
    assert network.server.counts["overflow"] and not network.server.counts["merged"]
    network.server._inbox._max_bytes = 1 << 28
    network.drain()
    assert network.server.counts["merged"] == 2


def test_too_large_a_message_is_not_made():
    noise = {"noise": np.random.default_rng(0).integers(-(1 << 62), 1 << 62, MAX_MESSAGE // 7)}
    with pytest.raises(MessageError, match="at most 33554432 bytes"):
        encode({}, [("noise", "int64", noise["noise"].shape)], noise)


def test_windows_that_are_too_large_to_send_are_an_error(monkeypatch):
    network = Network([Walker("a")])
    monkeypatch.setattr(messages, "MAX_MESSAGE", 5000)
    network.walk()
    network.exchange()
    assert "at most 5000 bytes" in str(network.outboxes["a"].error)


@pytest.mark.parametrize(
    ("question", "words"),
    [
        (b"nothing", "message"),
        (encode({"kind": "areas"}), "must ask for areas"),
        (ask_areas([[0, 0]], 60_000, 60_000, ["elevation"]), "area: must be at most 128 MiB"),
        (ask_areas([[0, 0]], 4, 4, ["color"]), "must be one of elevation"),
        (ask_areas([[1 << 50, 0]], 4, 4, ["elevation"]), "must ask for areas"),
    ],
)
def test_a_question_without_an_answer_is_told_why(question, words):
    server, answers = SiteServer(None), []
    server.ask(question, answers.append)
    server.step()
    with pytest.raises(ValueError, match=words):
        read_answer(answers[0])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("- a", "must hold a line for each robot"),
        ("a: short", "at least 16 characters, got 5 of them"),
        ("a/b: 0123456789abcdef", "must be 1 to 64 letters"),
        ("a: [", "cannot be read"),
        (None, "cannot be read"),
    ],
)
def test_a_file_of_keys_is_checked(tmp_path, text, words):
    path = tmp_path / "robots.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(RecordingError, match=words) as error:
        read_keys(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


def test_keys_are_read(tmp_path):
    path = tmp_path / "robots.yaml"
    path.write_text("spot-1: 0123456789abcdef\nspot-2: '0123456789abcdeg'\n")
    assert read_keys(path) == {"spot-1": "0123456789abcdef", "spot-2": "0123456789abcdeg"}
