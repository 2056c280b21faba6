"""The server of a page. It needs no torch: browsers load the page while the rest is imported."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
from typing import Any

from torchelev.errors import require

_MAX_PORT = 65535


def open_server(title: str, host: str = "127.0.0.1", port: int = 8080) -> Any:
    """Serve an empty page, and return viser's server.

    Args:
        title: of the page.
        host: "127.0.0.1" lets only this machine connect, "0.0.0.0" every machine that reaches it.
        port: of the page. If it is taken, the next free one is used.

    Raises:
        ModuleNotFoundError: viser is missing.
        ValueError: the port is invalid, or the host is not an address of this machine.
    """
    import viser

    require(0 < port <= _MAX_PORT, "port", f"must lie in [1, {_MAX_PORT}]", port, "use 8080")
    _require_own_address(host)
    logging.getLogger("websockets.server").addFilter(_is_worth_logging)
    with contextlib.redirect_stdout(io.StringIO()):  # its banner
        server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    # With viser's environment map, a browser without a GPU takes four seconds longer for its first picture.
    server.scene.configure_environment_map(None)
    server.scene.add_light_ambient("/sky")
    return server


def address_of(server: Any) -> str:
    """Return the page's address."""
    host = server.get_host()
    return f"http://{'localhost' if host in ('127.0.0.1', '0.0.0.0') else host}:{server.get_port()}"


def stop_server(server: Any) -> None:
    """Close the page."""
    with contextlib.redirect_stdout(io.StringIO()):  # its farewell
        server.stop()


def _is_worth_logging(record: logging.LogRecord) -> bool:
    """Return whether to log a server's message: browsers may connect in advance and then ask for nothing."""
    return "handshake failed" not in record.getMessage()


def _require_own_address(host: str) -> None:
    """Refuse an address at which the server cannot listen."""
    try:
        with socket.create_server((host, 0)):
            pass
    except OSError as error:
        actual, hint = f"{host!r} ({error.strerror})", "use 127.0.0.1, or 0.0.0.0 to let other machines connect"
        raise ValueError(f"host: must be an address of this machine, got {actual}; {hint}") from error
