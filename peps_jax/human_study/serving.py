"""The server as it runs: in a command, or in a thread beside a training."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

import uvicorn

from peps_jax.human_study import tokens
from peps_jax.human_study.server import Study, application

LOOPBACK = "127.0.0.1"
BACKLOG = 256
BEGINNING = 30.0  # s until a server in a thread has to be there
PARTING = 2  # s for requests under way when it ends


class Serving:
    """A study's pages at an address.

    Args:
      study: what is served.
      host: whose connections are taken; the default is this machine's alone.
      port: 0 for any that is free.
      behind_proxy: whether a proxy on this machine says, in X-Forwarded-For, where requests come from.

    Raises:
      ValueError: the port is taken, or there is no such host; one line says so.
    """

    def __init__(self, study: Study, host: str = LOOPBACK, port: int = 0, behind_proxy: bool = False):
        self.study = study
        self._socket = _listen(host, port)
        config = uvicorn.Config(
            application(study),
            log_config=None,
            access_log=False,  # participants' addresses are nobody's business
            log_level="warning",
            lifespan="off",
            server_header=False,
            proxy_headers=behind_proxy,
            forwarded_allow_ips=LOOPBACK,
            timeout_graceful_shutdown=PARTING,
        )
        self._server = uvicorn.Server(config)

    @property
    def address(self) -> str:
        """Where this machine reaches the pages."""
        host, port = self._socket.getsockname()[:2]
        host = {"0.0.0.0": LOOPBACK, "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
        return f"http://{host}:{port}"

    @property
    def researcher_link(self) -> str:
        return f"{self.address}/researcher#{tokens.derived(self.study.key, 'researcher')}"

    def run(self) -> None:
        """Serves until Ctrl-C or SIGTERM."""
        self._server.run(sockets=[self._socket])

    @contextlib.contextmanager
    def in_background(self) -> Iterator[Serving]:
        """Serves meanwhile, in a thread."""
        thread = threading.Thread(target=self.run, daemon=True)
        thread.start()
        until = time.monotonic() + BEGINNING
        while not self._server.started:
            if not thread.is_alive() or time.monotonic() > until:
                raise ValueError("the server didn't begin")
            time.sleep(0.01)
        try:
            yield self
        finally:
            self._server.should_exit = True
            thread.join()

    def close(self) -> None:
        self._socket.close()
        self.study.database.close()


def _listen(host: str, port: int) -> socket.socket:
    made = None
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        made = socket.socket(family, socket.SOCK_STREAM)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind((host, port))
        made.listen(BACKLOG)
    except (OSError, OverflowError) as error:
        if made is not None:
            made.close()
        why = getattr(error, "strerror", None) or error
        raise ValueError(f"port {port} of {host!r} can't be used: {why}; choose another --port") from None
    return made
