"""The Rerun viewer on this machine: a running one, or a new one."""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
from time import monotonic, sleep

from sceneslam.types.errors import ConfigError

HOST = "127.0.0.1"  # only this machine can connect
_STARTS_WITHIN_S = 30.0
_AS_A_PAGE = "sinks.live.viewer.web_port=9090"  # where viewer=rerun has it
_log = logging.getLogger(__name__)


class Viewer:
    """A viewer on 127.0.0.1; it stays open after the run and also shows later runs."""

    def __init__(self, *, port: int, web_port: int | None) -> None:
        """Set the ports; with a `web_port`, the viewer is a web page, else a window."""
        for name, value in (("port", port), ("web_port", web_port)):
            if value is not None and not 1024 <= value <= 65535:
                raise ConfigError(name, value, "1024 to 65535")
        self._port, self._web_port = port, web_port
        self.process: subprocess.Popen[bytes] | None = None  # started by this run

    @property
    def url(self) -> str:
        """Return the address to which recordings are sent."""
        return f"rerun+http://{HOST}:{self._port}/proxy"

    def open(self) -> str:
        """Start the viewer if none is running; return a sentence with its address.

        Raises ConfigError if it does not start.
        """
        if not _listens(self._port):
            if self._web_port is not None and _listens(self._web_port):
                raise ConfigError("web_port", self._web_port, "a port that is not in use")
            self._check_display()
            self.process = subprocess.Popen(
                self._command(),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C ends the run, not the viewer
            )
            self._wait()
        where = f"window on port {self._port}"
        if self._web_port is not None:
            address = self.url.replace("+", "%2B")
            where = f"http://{HOST}:{self._web_port}/?url={address}"
        stays = f"; it stays open: `kill -- -{self.process.pid}` ends it" if self.process else ""
        return f"Rerun: {where}{stays}"

    def _check_display(self) -> None:
        """Raise ConfigError if there is no display for a window."""
        is_linux = sys.platform.startswith("linux")
        has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
        if self._web_port is None and is_linux and not has_display:
            allowed = f"a port, as {_AS_A_PAGE}: there is no display for a window"
            raise ConfigError("web_port", None, allowed)

    def _command(self) -> list[str]:
        command = [sys.executable, "-m", "rerun", "--bind", HOST, "--port", str(self._port)]
        if self._web_port is not None:
            command += ["--serve-web", "--web-viewer-port", str(self._web_port)]
        return command

    def _wait(self) -> None:
        assert self.process is not None
        until_s = monotonic() + _STARTS_WITHIN_S
        while not _listens(self._port):
            if self.process.poll() is not None or monotonic() > until_s:
                allowed = f"a port on which the viewer can start; without a display: {_AS_A_PAGE}"
                raise ConfigError("port", self._port, allowed)
            sleep(0.05)


def _listens(port: int) -> bool:
    try:
        socket.create_connection((HOST, port), timeout=0.5).close()
    except OSError:
        return False
    return True
