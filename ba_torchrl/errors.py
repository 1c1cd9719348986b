"""The exceptions that users catch."""

from __future__ import annotations


class ConfigError(ValueError):
    """A configuration that cannot be used; the message says what is allowed."""


class UnknownNameError(ConfigError, KeyError):
    """A name that a registry does not hold; the message lists those it holds."""

    def __str__(self) -> str:
        return str(self.args[0])


class DamagedFilesError(ConfigError):
    """Files that are incomplete or altered; the message names the first one."""


class InvalidActionError(ValueError):
    """An action of the wrong shape, or one that is not finite."""


class SimulationError(RuntimeError):
    """The simulator failed, or was asked for something it cannot do."""


class PlacementError(RuntimeError):
    """No free place was found for the objects; the workspace is too small for them."""


class WorkerError(RuntimeError):
    """A worker process raised, died or did not answer in time; the message says which."""


class ReplaySchemaError(ValueError):
    """Transitions whose entries, types or shapes differ from those already stored."""
