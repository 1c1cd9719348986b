"""Saved states of a world: in PyBullet's memory, or as bytes for another world."""

from __future__ import annotations

import contextlib
import tempfile
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, Self

import pybullet


class Snapshot:
    """A state of a world in PyBullet's memory, freed when this object is deleted.

    Args:
        client: PyBullet's client id.
        connection: finalizer of the world that owns the client.
    """

    def __init__(self, client: int, connection: weakref.finalize) -> None:
        self.client = client
        self.connection = connection
        self.id = pybullet.saveState(physicsClientId=client)
        weakref.finalize(self, _remove_state, self.id, client, connection)

    def load(self, client: int) -> None:
        """Load the state into the client that it is of."""
        pybullet.restoreState(self.id, physicsClientId=client)

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a state of get_state is of one process and needs no copy, since it never changes; to "
            "keep or send the state of an environment, copy or pickle the environment"
        )


@dataclass(frozen=True)
class PortableSnapshot:
    """A state of a world as bytes, for worlds with the same bodies in this or another process."""

    content: bytes

    @classmethod
    def of(cls, client: int) -> Self:
        """Return the present state of a client."""
        with _temporary_file() as path:
            pybullet.saveBullet(path, physicsClientId=client)
            return cls(Path(path).read_bytes())

    def load(self, client: int) -> None:
        """Load the state into a client with the same bodies."""
        with _temporary_file() as path:
            Path(path).write_bytes(self.content)
            pybullet.restoreState(fileName=path, physicsClientId=client)


@contextlib.contextmanager
def _temporary_file() -> Iterator[str]:
    with tempfile.TemporaryDirectory(prefix="ba_torchrl-") as folder:
        yield f"{folder}/world.bullet"


def _remove_state(state: int, client: int, connection: weakref.finalize) -> None:
    if connection.alive:  # otherwise the client id may already belong to another world
        pybullet.removeState(state, physicsClientId=client)
