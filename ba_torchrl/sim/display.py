"""The X display that PyBullet's window needs."""

from __future__ import annotations

import os
import re
import socket

_TIMEOUT_S = 3.0
_FIRST_TCP_PORT = 6000
_GREETING = b"l\0\x0b\0\0\0\0\0\0\0\0\0"
"""Request of a connection: little endian, X11, without authorization."""


def why_no_display() -> str | None:
    """Return why no window can be opened, None if the display answers.

    PyBullet would end the process without a display, and wait for one that does not answer.
    """
    name = os.environ.get("DISPLAY", "")
    if not name:
        return "DISPLAY is not set"
    match = re.fullmatch(r"(?P<host>.*):(?P<number>\d+)(\.\d+)?", name)
    if match is None:
        return f"DISPLAY={name} is not the name of a display"
    number = int(match["number"])
    try:
        with _connect(match["host"], number) as connection:
            connection.settimeout(_TIMEOUT_S)
            connection.sendall(_GREETING)
            if connection.recv(1):
                return None
    except OSError as error:
        return f"DISPLAY={name} does not answer: {error}"
    return f"DISPLAY={name} closed the connection"


def _connect(host: str, number: int) -> socket.socket:
    if host not in ("", "unix"):
        return socket.create_connection((host, _FIRST_TCP_PORT + number), _TIMEOUT_S)
    path = f"/tmp/.X11-unix/X{number}"
    for address in (path, f"\0{path}"):  # a file, or Linux's abstract name
        connection = socket.socket(socket.AF_UNIX)
        connection.settimeout(_TIMEOUT_S)
        try:
            connection.connect(address)
        except OSError:
            connection.close()
        else:
            return connection
    raise ConnectionRefusedError(f"no server at {path}")
