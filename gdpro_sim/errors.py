"""One exception family. Every message names the value, the place and the way out."""

from __future__ import annotations


class GdproError(Exception):
    """Base of every error this package raises on purpose.

    `exit_code` is what the command line returns: 2 for a wrong request, 1 for a run that failed.
    """

    exit_code = 1


class RequestError(GdproError):
    """The request itself is wrong: a missing file, an unknown option value, an unwritable output."""

    exit_code = 2


class AssetError(RequestError):
    """An asset file cannot be read, or an asset's parts do not fit together."""


class MeshError(RequestError):
    """A mesh cannot be loaded, bound or tetrahedralized."""


class SceneError(RequestError):
    """A scene description is wrong."""


class GuidanceError(RequestError):
    """A prompt, a prior, pictures or a diffusion model cannot guide a generation."""


class DeviceError(RequestError):
    """The requested compute device does not exist here."""


class SolverError(GdproError):
    """A solver could not advance the simulation."""


class OutputError(GdproError):
    """Results cannot be written (disk full, permission lost)."""


__all__ = [
    "AssetError",
    "DeviceError",
    "GdproError",
    "GuidanceError",
    "MeshError",
    "OutputError",
    "RequestError",
    "SceneError",
    "SolverError",
]
