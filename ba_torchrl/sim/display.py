"""PyBullet's window, and the X display that it needs."""

from __future__ import annotations

import os
import re
import socket
import sys

import pybullet

from ba_torchrl.errors import SimulationError

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


def connect_window() -> int:
    """Open PyBullet's window and return its client.

    Raises:
        SimulationError: there is no display, or the process already has a window.
    """
    reason = why_no_display() if sys.platform.startswith("linux") else None
    if reason is not None:
        raise SimulationError(
            f"render=True opens a window, but there is no display ({reason}): use "
            "env.render() for images, or run under a virtual display such as xvfb-run"
        )
    try:
        client = pybullet.connect(pybullet.GUI, options="--width=960 --height=720")
    except pybullet.error as error:
        raise SimulationError(
            f"PyBullet cannot open a window ({error}): a process can have only one"
        ) from None
    if client >= 0:
        pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, physicsClientId=client)
    return client


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
