"""Connect a `SiteServer` to the network, and run it."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from torchelev.site.service.server.answers import Answer
from torchelev.site.service.server.merger import SiteServer
from torchelev.site.service.wire.access import check_name
from torchelev.site.service.wire.transport import ENDPOINT, MergerToken, as_list, calling, import_zenoh, open_session

if TYPE_CHECKING:
    from typing_extensions import Self

_WAIT = 0.2  # [s] between looks at whether to end
_AFTER_ERROR = 1.0  # [s] until messages are taken again after the disk was full


class NetworkedServer:
    """A `SiteServer` on Zenoh. Use it in a `with` block.

    Args:
        server: that merges.
        site: name of the site on the network.
        listen: endpoints of Zenoh to listen on; None: `ENDPOINT`, which is on the loopback,
            unless `connect` or `config` is given.
        connect: endpoints of routers or other machines to connect to.
        config: file of Zenoh's own configuration, for TLS, users and access control.
        session: of Zenoh, in place of a new one.

    Raises:
        ValueError: the name has other characters than letters, digits, _ . and -, or the configuration is none.
        OSError: an endpoint is taken, or another merger serves a site of this name.
        ModuleNotFoundError: eclipse-zenoh is missing.
    """

    def __init__(
        self,
        server: SiteServer,
        site: str = "site",
        *,
        listen: str | Sequence[str] | None = None,
        connect: str | Sequence[str] | None = None,
        config: str | Path | None = None,
        session: Any = None,
    ) -> None:
        self.server, self._root = server, f"torchelev/{check_name('site', site)}"
        if listen is None and connect is None and config is None:
            listen = ENDPOINT
        given = (*as_list(listen or ()), *as_list(connect or ()))
        #: where it listens and what it connects to, as given
        self.endpoints = " ".join(given if config is None else (*given, str(config)))
        self._session = open_session("router", listen, connect, config) if session is None else session
        self._owns, self._declared = session is None, []  # type: bool, list[Any]
        try:
            self._token = MergerToken(self._session, site, time.time_ns(), uuid.uuid4().hex)
        except BaseException:
            self._close_session()
            raise
        declare = self._session.declare_subscriber
        self._declared = [declare(f"{self._root}/windows/*", calling(self._take))]
        self._declared.append(self._session.declare_queryable(f"{self._root}/areas", calling(self._ask), complete=True))

    def _take(self, sample: Any) -> None:
        self.server.handle(sample.payload.to_bytes(), str(sample.key_expr).rsplit("/", 1)[1])

    def _ask(self, query: Any) -> None:
        payload = b"" if query.payload is None else query.payload.to_bytes()

        zenoh = import_zenoh()

        def answer(found: bytes) -> None:
            with suppress(zenoh.ZError), query:  # whoever asked has left
                query.reply(str(query.key_expr), found)

        self.server.ask(payload, answer)

    def _send(self, answer: Answer) -> None:
        zenoh = import_zenoh()
        key = "versions" if answer.robot is None else f"answers/{answer.robot}"
        # A robot that takes nothing must not hold up the others: it asks again for what is lost here.
        self._session.put(f"{self._root}/{key}", answer.payload, congestion_control=zenoh.CongestionControl.DROP)

    def run(self, should_end: Callable[[], bool], on_error: Callable[[OSError], None] | None = None) -> None:
        """Merge until `should_end` returns True.

        Args:
            should_end: is asked several times a second.
            on_error: called when a commit has failed, as of a full disk; the robots send again. None: raise.

        Raises:
            OSError: an older merger serves a site of this name, or without `on_error`, a commit has failed.
        """
        while not should_end():
            self._token.require_alone()
            try:
                answers = self.server.step(_WAIT)
            except OSError as error:
                if on_error is None:
                    raise
                on_error(error)
                time.sleep(_AFTER_ERROR)
                continue
            for answer in answers:
                self._send(answer)

    def _close_session(self) -> None:
        if self._owns:
            self._session.close()

    def close(self) -> None:
        """Leave the network. The server's site stays open."""
        for each in self._declared:
            each.undeclare()
        self._declared = []
        self._token.close()
        self._close_session()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
