"""A window is refused at once where no X server answers."""

import socket
import threading
import time

import pytest

from ba_torchrl.core.errors import SimulationError
from ba_torchrl.sim import world as display
from ba_torchrl.sim.world import World, why_no_display


@pytest.fixture
def server(monkeypatch):
    """A listening socket at the place of a display; what it answers is set by the test."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        monkeypatch.setattr(display, "_FIRST_TCP_PORT", listener.getsockname()[1])
        monkeypatch.setattr(display, "_TIMEOUT_S", 0.3)
        monkeypatch.setenv("DISPLAY", "127.0.0.1:0.0")
        yield listener


def answer(listener, reply):
    def serve():
        connection, _ = listener.accept()
        with connection:
            connection.recv(12)
            connection.sendall(reply)

    threading.Thread(target=serve, daemon=True).start()


def test_a_display_that_answers_is_accepted(server):
    answer(server, b"\x01")
    assert why_no_display() is None


def test_a_display_that_does_not_answer_is_refused_at_once(server):
    started = time.monotonic()
    assert "does not answer" in why_no_display()
    with pytest.raises(SimulationError, match=r"no display \(DISPLAY=.*does not answer"):
        World(window=True)
    assert time.monotonic() - started < 5


def test_a_display_that_closes_is_refused(server):
    answer(server, b"")
    assert "closed the connection" in why_no_display()


@pytest.mark.parametrize("name", ["", ":4711", "nonsense", "unix:4711.0"])
def test_a_display_that_is_not_there_is_refused(monkeypatch, name):
    monkeypatch.setenv("DISPLAY", name)
    assert why_no_display() is not None
