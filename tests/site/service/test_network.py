"""Robots, readers and mergers on the loopback, over Zenoh."""

import contextlib
import signal
import subprocess
import sys
import threading
import time
import warnings

import pytest
import torch

from tests.helpers import pose, wait_for
from tests.processes import ROOT
from tests.site.helpers import known_cells
from tests.site.service.processes import KILLED, Cable, MergerProcess
from tests.site.service.walks import START, Walker, assert_same
from torchelev.site import SiteMap
from torchelev.site.service import NetworkedServer, RefusedError, RobotLink, SiteReader, SiteServer

zenoh = pytest.importorskip("zenoh")


@pytest.fixture(autouse=True)
def times_may_go_back():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        yield


@contextlib.contextmanager
def serving(port, server=None, **options):
    """A merger in a thread of this process."""
    server = server or SiteServer(None, resolution=0.1, align=False, clock=lambda: START + 1e6)
    with NetworkedServer(server, listen=f"tcp/127.0.0.1:{port}", **options) as network:
        done = threading.Event()
        thread = threading.Thread(target=network.run, args=[done.is_set])
        thread.start()
        try:
            yield server
        finally:
            done.set()
            server.wake()
            thread.join()


def walk(walkers, links, direct, steps=4, dx=0.4):
    """Let robots walk, publish, and merge directly, too."""
    for _ in range(steps):
        for walker, link in zip(walkers, links, strict=True):
            walker.step(dx=dx)
            direct.merge(walker.emap, time=walker.time, align=False)
            link.publish(walker.time)


@pytest.mark.slow(1)
def test_robots_publish_read_and_hear_of_new_versions(port):
    at, direct, walkers, heard = f"tcp/127.0.0.1:{port}", SiteMap(0.1), [Walker("a"), Walker("b", 1.0, 1)], []
    with contextlib.ExitStack() as stack:
        links = [stack.enter_context(RobotLink(each.emap, each.name, connect=at)) for each in walkers]
        walk(walkers, links, direct)  # before there is a merger
        assert not links[0].flush(0.2) and links[0].version == ""
        server = stack.enter_context(serving(port))
        reader = stack.enter_context(SiteReader(connect=at, on_version=heard.append))
        assert all(link.flush() for link in links)
        walk(walkers, links, direct, steps=2)
        assert all(link.flush() for link in links)
        wait_for(lambda: reader.version == server.site.version and heard[-1:] == [reader.version])
        assert_same(server.site, direct)
        found = reader.window((1.0, 0.5), 2.0, 1.5, ["elevation", "validity"])
        expected = direct.window((1.0, 0.5), 2.0, 1.5, ["elevation", "validity"])
        for name, layer in expected.layers.items():
            torch.testing.assert_close(torch.as_tensor(found.layers[name]), torch.as_tensor(layer), equal_nan=True)
        assert found.center.tolist() == expected.center.tolist()
        with pytest.raises(ValueError, match="must be one of elevation, .*got 'colour'"):
            reader.window((0.0, 0.0), 1.0, 1.0, ["colour"])
        assert int(links[0].report.new_cells) > 0 and links[0].report.offsets.tolist() == [0.0]


@pytest.mark.slow(1)
@pytest.mark.parametrize("is_first_reset", [False, True])
def test_a_newcomer_is_filled_and_what_it_got_does_not_count_again(port, is_first_reset):
    at, walker, newcomer = f"tcp/127.0.0.1:{port}", Walker("a"), Walker("b")
    sites = SiteMap(0.1), SiteMap(0.1)
    with serving(port) as server, RobotLink(walker.emap, "a", connect=at) as link:
        walk([walker], [link], sites[0])
        assert link.flush()
        with RobotLink(newcomer.emap, "b", connect=at) as other:
            if is_first_reset:
                walk([newcomer], [other], sites[0], steps=2, dx=-0.5)
                assert other.flush()
                newcomer.emap.reset()
            newcomer.emap.initialize_from(other, pose((1.0, 0.0, 1.0)))
            copy = Walker("b")
            copy.emap.initialize_from(sites[0], pose((1.0, 0.0, 1.0)))
            torch.testing.assert_close(newcomer.emap.state.elevation, copy.emap.state.elevation)
            assert newcomer.emap.state.validity.float().mean() > 0.5
            before = known_cells(server.site, "variance")
            other.publish(walker.time)
            assert other.flush()
            assert known_cells(server.site, "variance") == before
            newcomer.x, newcomer.time = 1.0, walker.time
            newcomer.step(dx=0.1)
            other.publish(newcomer.time)
            assert other.flush() and int(other.report.new_cells) > 100


@pytest.mark.slow(1)
def test_what_cannot_be_filled_changes_nothing(port):
    walker = Walker("a")
    walker.step()
    before = {name: value.clone() for name, value in walker.emap.state_dict().items() if torch.is_tensor(value)}
    with RobotLink(walker.emap, "a", connect=f"tcp/127.0.0.1:{port}") as link:
        with pytest.raises(TimeoutError, match="a merger must answer within 5 s"):
            walker.emap.initialize_from(link)
    for name, value in before.items():
        assert torch.equal(value, walker.emap.state_dict()[name]), name


DEATHS = [
    ("writing", "files"),
    ("committed", "files"),
    ("before the answer", "files"),
    ("writing", "icechunk"),
    ("before the answer", "icechunk"),
]


@pytest.mark.slow(6)
@pytest.mark.parametrize(("place", "engine"), DEATHS)
def test_a_merger_that_is_killed_counts_nothing_twice_and_loses_nothing(tmp_path, port, place, engine):
    if engine == "icechunk":
        pytest.importorskip("icechunk")
    direct, walkers = SiteMap(0.1), [Walker("a"), Walker("b", 1.0, 1)]
    for walker in walkers:
        walker.time = time.time() - 1000.0
    with contextlib.ExitStack() as stack:
        at = f"tcp/127.0.0.1:{port}"
        links = [stack.enter_context(RobotLink(each.emap, each.name, connect=at)) for each in walkers]
        with MergerProcess(tmp_path / "site", port, place, 3, engine) as merger:
            for _ in range(4):
                walk(walkers, links, direct, steps=1)
                time.sleep(0.3)
            assert merger.wait() == KILLED
        with MergerProcess(tmp_path / "site", port, engine=engine):
            assert all(link.flush(20.0) for link in links)
    with SiteMap.open(tmp_path / "site", read_only=True) as site:
        assert_same(site, direct)


@pytest.mark.slow(9)
def test_a_partition_loses_nothing(tmp_path, port):
    direct, walkers = SiteMap(0.1), [Walker("a"), Walker("b", 1.0, 1)]
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(serving(port))
        cable = stack.enter_context(contextlib.closing(Cable(port)))
        ports = cable.port, port  # the second robot stays connected
        links = [
            stack.enter_context(RobotLink(each.emap, each.name, connect=f"tcp/127.0.0.1:{own}"))
            for each, own in zip(walkers, ports, strict=True)
        ]
        walk(walkers, links, direct, steps=2)
        assert all(link.flush() for link in links)
        cable.pull()
        for _ in range(15):  # half a second each, in place of two
            walk(walkers, links, direct, steps=1, dx=0.5)
            time.sleep(0.2)
        assert links[1].flush() and not links[0].flush(0.5)
        assert links[0].waiting_bytes > 0
        cable.plug_in()
        assert links[0].flush(20.0)
        assert_same(server.site, direct)


@pytest.mark.slow(3)
def test_a_merger_that_stands_still_for_a_while_goes_on(tmp_path, port):
    direct, walker = SiteMap(0.1), Walker("a")
    walker.time = time.time() - 1000.0
    with MergerProcess(tmp_path / "site", port) as merger:
        with RobotLink(walker.emap, "a", connect=f"tcp/127.0.0.1:{port}") as link:
            walk([walker], [link], direct, steps=2)
            assert link.flush()
            merger.signal(signal.SIGSTOP)
            walk([walker], [link], direct, steps=3)
            assert not link.flush(2.0)  # sent again meanwhile
            merger.signal(signal.SIGCONT)
            assert link.flush()
    with SiteMap.open(tmp_path / "site", read_only=True) as site:
        assert_same(site, direct)


@pytest.mark.slow(2)
def test_a_second_merger_is_refused(tmp_path, port):
    with serving(port, SiteServer(tmp_path / "site", engine="files")):
        with pytest.raises(OSError, match="expected one writer at a time"):
            SiteServer(tmp_path / "site")
        with pytest.raises(OSError, match="listen: must be free endpoints"):
            NetworkedServer(SiteServer(None), listen=f"tcp/127.0.0.1:{port}")
        with pytest.raises(OSError, match="must have one merger, and site has one already"):
            NetworkedServer(SiteServer(None), connect=f"tcp/127.0.0.1:{port}", listen=[])
        with NetworkedServer(SiteServer(None), "other", connect=f"tcp/127.0.0.1:{port}", listen=[]):
            pass  # of another name


@pytest.mark.slow(2)
def test_of_two_mergers_that_meet_later_the_younger_ends(port):
    with serving(port), contextlib.closing(Cable(port)) as cable:
        cable.pull()
        connect = f"tcp/127.0.0.1:{cable.port}"
        with NetworkedServer(SiteServer(None), connect=connect, listen=[]) as younger:
            deadline = time.monotonic() + 15.0
            younger.run(lambda: True)
            cable.plug_in()
            with pytest.raises(OSError, match="must have one merger, got an older one"):
                younger.run(lambda: time.monotonic() > deadline)


@pytest.mark.slow(2)
def test_a_robot_may_not_write_for_another_one_if_there_are_keys(port):
    keys = {"a": "a" * 16, "b": "b" * 16}
    server = SiteServer(None, resolution=0.1, keys=keys, clock=lambda: START + 1e6)
    at, walker = f"tcp/127.0.0.1:{port}", Walker("a")
    walker.step()
    with serving(port, server), contextlib.ExitStack() as stack:
        for robot, key in (("a", keys["b"]), ("a", None), ("c", keys["a"])):
            with RobotLink(walker.emap, robot, connect=at, key=key) as link:  # which sends again until it is closed
                link.publish(walker.time)
                assert not link.flush(0.5) and len(server.site) == 0
        assert server.counts["refused"] >= 3
        own = stack.enter_context(RobotLink(walker.emap, "a", connect=at, key=keys["a"]))
        own.publish(walker.time)
        assert own.flush() and server.counts["merged"] == 1
        # What a wrote, put under the name of b, is refused, too.
        session = stack.enter_context(zenoh.open(_client(at)))
        seen = []
        session.declare_subscriber("torchelev/site/windows/a", lambda sample: seen.append(sample.payload.to_bytes()))
        time.sleep(0.3)
        walker.step()
        own.publish(walker.time)
        assert own.flush()
        refused = server.counts["refused"]
        session.put("torchelev/site/windows/b", seen[-1])
        session.put("torchelev/site/windows/a", seen[-1])
        wait_for(lambda: server.counts["refused"] == refused + 1 and server.counts["repeated"] >= 1)
        assert server.counts["merged"] == 2


def _client(at):
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{at}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    return config


@pytest.mark.slow(1)
def test_a_robot_is_told_why_it_is_refused(port):
    walker = Walker("a")
    walker.step()
    with serving(port), RobotLink(walker.emap, "a", connect=f"tcp/127.0.0.1:{port}") as link:
        link.publish(START + 2e6)  # its clock is far ahead
        with pytest.raises(RefusedError, match="must be on the clock that all robots and the merger share"):
            link.flush()
        with pytest.raises(RefusedError):
            link.publish()


@pytest.mark.slow(4)
@pytest.mark.parametrize("kind", ["robot", "merger"])
def test_a_program_that_closes_nothing_ends(port, kind):
    """Python waits at its end for threads of Zenoh that call functions, if they are asked for."""
    start = {
        "robot": "from torchelev import ElevationMap as E; link = RobotLink(E(), 'a', connect=at); link.publish()",
        "merger": "network = NetworkedServer(SiteServer(None), listen=at)",
    }
    code = f"from torchelev.site.service import *; at = 'tcp/127.0.0.1:{port}'; {start[kind]}; print('end', flush=True)"
    ended = subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=60, capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (0, "end\n"), ended.stderr


@pytest.mark.slow(1)
def test_only_the_loopback_is_listened_on(port):
    import socket

    with serving(port):
        with socket.create_connection(("127.0.0.1", port), timeout=5):
            pass
        others = socket.gethostbyname(socket.gethostname())
        if not others.startswith("127."):
            with pytest.raises(OSError):
                socket.create_connection((others, port), timeout=2)
