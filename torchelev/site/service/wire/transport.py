"""Zenoh: the keys that robots, mergers and readers use, and what is sent by them.

| key | | |
|---|---|---|
| `torchelev/SITE/windows/ROBOT` | put | a robot's messages to the merger |
| `torchelev/SITE/answers/ROBOT` | put | the merger's to the robot |
| `torchelev/SITE/versions` | put | of each merge |
| `torchelev/SITE/areas` | query | areas of the site |
| `torchelev/SITE/merger/START-ID` | liveliness | the process that merges |

By default, sessions listen on and connect to the loopback only, and do not search for peers by multicast.
"""

from __future__ import annotations

import atexit
import json
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from torchelev.errors import message, require

ENDPOINT = "tcp/127.0.0.1:7450"
_ROOT = "torchelev"
_START_DIGITS = 20  # of nanoseconds, so that keys sort by time


class Channel(Protocol):
    """The connection of a robot or reader to a merger. Messages may be lost, repeated and reordered."""

    def start(self, receive: Callable[[bytes], None], on_merger: Callable[[], None]) -> None:
        """Begin to call `receive` with each message, and `on_merger` when a merger comes."""

    def send(self, payload: bytes) -> None:
        """Send a message to the merger."""

    def ask(self, payload: bytes, timeout: float) -> bytes | None:
        """Return the merger's answer to a question; None: there is none within `timeout` [s]."""

    def close(self) -> None:
        """End it."""


def import_zenoh() -> Any:
    """Import Zenoh, or raise ModuleNotFoundError that says how to install it."""
    try:
        import zenoh
    except ModuleNotFoundError as error:
        if error.name != "zenoh":
            raise
        text = 'the service of a site needs eclipse-zenoh: pip install "torchelev[serve]"'
        raise ModuleNotFoundError(text, name=error.name) from error
    return zenoh


def open_session(
    mode: str,
    listen: str | Sequence[str] | None = None,
    connect: str | Sequence[str] | None = None,
    config: str | Path | None = None,
) -> Any:
    """Open a session of Zenoh.

    Args:
        mode: "router" of a merger, "peer" of others: a peer needs nobody to be there when it starts.
        listen: endpoints to listen on; None: those of the file, or none.
        connect: endpoints to connect to, again and again; None: those of the file, or none.
        config: file of Zenoh's own configuration, in which `mode` and all else that is not given here holds.

    Raises:
        ValueError: the file or an endpoint is not one of Zenoh's.
        OSError: an endpoint to listen on is taken.
        ModuleNotFoundError: eclipse-zenoh is missing.
    """
    zenoh = import_zenoh()
    try:
        settings = zenoh.Config() if config is None else zenoh.Config.from_file(str(config))
        own = {"mode": mode, "scouting/multicast/enabled": False, "scouting/gossip/enabled": False}
        given = {"listen/endpoints": listen, "connect/endpoints": connect}
        own = {} if config is not None else own | {name: [] for name in given}
        own |= {name: as_list(value) for name, value in given.items() if value is not None}
        for name, value in own.items():
            settings.insert_json5(name, json.dumps(value))
        if config is None:
            settings.insert_json5("connect/exit_on_failure", "false")
            settings.insert_json5("connect/timeout_ms", "-1")
    except zenoh.ZError as error:
        where = "endpoints" if config is None else str(config)
        raise ValueError(message(where, "must be those of Zenoh", _short(error), "see its manual")) from error
    try:
        session = zenoh.open(settings)
        atexit.register(_close, session)  # an open session may keep Python from ending
        return session
    except zenoh.ZError as error:
        hint = "is another merger or router running there? choose another endpoint, or connect to it"
        raise OSError(message("listen", f"must be free endpoints, such as {ENDPOINT}", _short(error), hint)) from error


def calling(function: Callable[[Any], None]) -> Any:
    """Return a handler that calls a function in Zenoh's threads: in others, Python would wait for them at its end."""
    return import_zenoh().handlers.Callback(function, indirect=False)


def _close(session: Any) -> None:
    """Close a session, unless it is closed."""
    if not session.is_closed():
        session.close()


def as_list(value: str | Sequence[str]) -> list[str]:
    """Return one or several endpoints as a list."""
    return [value] if isinstance(value, str) else list(value)


def _short(error: Exception) -> str:
    """Return an error of Zenoh without the places in its sources."""
    return " ".join(str(error).split(" at /")[0].split())


def open_channel(
    site: str, connect: str | Sequence[str] | None, config: str | Path | None, robot: str | None = None
) -> ZenohChannel:
    """Return a connection to the merger of a site; by default, to one on this machine."""
    own = ENDPOINT if connect is None and config is None else connect
    return ZenohChannel(open_session("peer", None, own, config), site, robot, owns_session=True)


class ZenohChannel:
    """The connection of a robot or reader, over Zenoh.

    Args:
        session: of Zenoh.
        site: name of the site on the network.
        robot: name of the robot; None: a reader, which sends nothing.
        owns_session: whether `close` closes the session.
    """

    def __init__(self, session: Any, site: str, robot: str | None, owns_session: bool = False) -> None:
        self._session, self._root, self._robot, self._owns = session, f"{_ROOT}/{site}", robot, owns_session
        self._declared: list[Any] = []

    def start(self, receive: Callable[[bytes], None], on_merger: Callable[[], None]) -> None:
        """Begin to call `receive` with each message, and `on_merger` when a merger comes."""
        zenoh = import_zenoh()

        def take(sample: Any) -> None:
            receive(sample.payload.to_bytes())

        def see(sample: Any) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                on_merger()

        keys = ["versions"] + ([] if self._robot is None else [f"answers/{self._robot}"])
        self._declared = [self._session.declare_subscriber(f"{self._root}/{key}", calling(take)) for key in keys]
        live = self._session.liveliness()
        self._declared.append(live.declare_subscriber(f"{self._root}/merger/*", calling(see), history=True))

    def send(self, payload: bytes) -> None:
        """Send a message to the merger; waits while the network takes no more."""
        zenoh = import_zenoh()
        key = f"{self._root}/windows/{self._robot}"
        with suppress(zenoh.ZError):  # the session closes
            self._session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def ask(self, payload: bytes, timeout: float) -> bytes | None:
        """Return the merger's answer to a question; None: there is none within `timeout` [s]."""
        replies = self._session.get(f"{self._root}/areas", payload=payload, timeout=timeout)
        return next((reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None), None)

    def close(self) -> None:
        """End it."""
        for each in self._declared:
            each.undeclare()
        self._declared = []
        if self._owns:
            self._session.close()


class MergerToken:
    """Announces a merger, and notices another one.

    Args:
        session: of Zenoh.
        site: name of the site on the network.
        start: [ns] when this merger started: of two, the later one must end.
        own_id: of this process.

    Raises:
        OSError: another merger serves a site of this name.
    """

    def __init__(self, session: Any, site: str, start: int, own_id: str) -> None:
        self._site, self._own, self.has_lost = site, f"{start:0{_START_DIGITS}d}-{own_id}", threading.Event()
        root = f"{_ROOT}/{site}/merger"
        live = session.liveliness()
        others = [str(reply.ok.key_expr) for reply in live.get(f"{root}/*", timeout=1.0) if reply.ok is not None]
        require(not others, "site", f"must have one merger, and {site} has one already", others[0] if others else "",
                "end the other one, or give this site another --name", OSError)  # fmt: skip
        self._token = live.declare_token(f"{root}/{self._own}")
        self._watcher = live.declare_subscriber(f"{root}/*", calling(self._see), history=True)

    def _see(self, sample: Any) -> None:
        zenoh = import_zenoh()
        if sample.kind == zenoh.SampleKind.PUT and str(sample.key_expr).rsplit("/", 1)[1] < self._own:
            self.has_lost.set()

    def require_alone(self) -> None:
        """Raise OSError if a merger that started earlier serves a site of this name."""
        hint = "robots go on with the other one; end this one, or give this site another --name"
        require(
            not self.has_lost.is_set(), "site", "must have one merger", f"an older one of {self._site}", hint, OSError
        )

    def close(self) -> None:
        """Announce that the merger has left."""
        self._watcher.undeclare()
        self._token.undeclare()
