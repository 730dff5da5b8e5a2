"""Finished frames of a run that is not complete yet, kept so that it can go on to the same bytes.

`.resume/` holds `run.json` (which scene, device and assets), `frame_NNNNN.npz` (surfaces and figures of each
finished frame) and `state_NNNNN.npz` (the solver's state after it).
"""

from __future__ import annotations

import json
import logging
import shutil
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim.errors import OutputError
from gdpro_sim.files import atomic_write, prepare_folder, sha256_of
from gdpro_sim.simulation.model import Diagnostics

logger = logging.getLogger(__name__)

STATES = 256 << 20
"""Bytes of solver states that are kept; the last is enough unless its file, or a frame's, is damaged."""

State = dict[str, np.ndarray]


@dataclass(frozen=True)
class StoredFrame:
    """A finished frame.

    surfaces: [V, 3] float32 m of each body
    solve:    milliseconds it took
    colliders: as in `gdpro_sim.simulation.frame.Frame`
    """

    surfaces: list[np.ndarray]
    diagnostics: Diagnostics
    solve: float
    colliders: np.ndarray | None = None


class Store:
    """The finished frames of a run, by number.

    resumed: how many there were when it was opened, from 0 on; the run continues after them
    """

    def __init__(self, folder: Path, fingerprint: str, fresh: bool) -> None:
        self.folder = folder
        self._fingerprint = fingerprint
        self._assets: dict[str, str] = {}
        known: dict[str, Any] = {}
        try:
            read = json.loads((folder / "run.json").read_text(encoding="utf-8"))
            known = read if isinstance(read, dict) else {}
        except (OSError, ValueError):
            pass
        if fresh or known.get("fingerprint") != fingerprint:
            if not fresh and known:
                logger.warning(
                    "%s holds a stopped run of another scene, device or version: starting anew", folder.parent
                )
            shutil.rmtree(folder, ignore_errors=True)
        else:
            self._assets = dict(known.get("assets", {}))
        prepare_folder(folder, "run.json")
        self._write_marker()
        self._state: State = {}
        self.resumed = self._whole()

    def _write_marker(self) -> None:
        with atomic_write(self.folder / "run.json") as temporary:
            temporary.write_text(
                json.dumps({"fingerprint": self._fingerprint, "assets": self._assets}), encoding="utf-8"
            )

    def _frame(self, index: int) -> Path:
        return self.folder / f"frame_{index:05d}.npz"

    def _state_file(self, index: int) -> Path:
        return self.folder / f"state_{index:05d}.npz"

    def _whole(self) -> int:
        """How many frames from 0 on can be read, the last of them with its state, which is read."""
        count = 0
        while self._frame(count).exists() and _read(self._frame(count)) is not None:
            count += 1
        while count > 0:
            state = _read(self._state_file(count - 1)) if self._state_file(count - 1).exists() else None
            if state is not None:
                self._state = state
                return count
            count -= 1
        return 0

    def has_assets(self, paths: list[Path]) -> bool:
        """Whether the asset files are the ones this run wrote."""
        return bool(self._assets) and all(
            p.is_file() and self._assets.get(p.name) == sha256_of(p) for p in paths
        )

    def assets_saved(self, paths: list[Path]) -> None:
        """Tets are not repeatable: frames of other assets are of no use."""
        for pattern in ("frame_*.npz", "state_*.npz"):
            for old in self.folder.glob(pattern):
                old.unlink()
        self.resumed, self._state = 0, {}
        self._assets = {p.name: sha256_of(p) for p in paths}
        self._write_marker()

    def load(self, index: int) -> StoredFrame | None:
        """A finished frame, or None where the run has not come so far."""
        if index >= self.resumed:
            return None
        data = _read(self._frame(index))
        if data is None:
            raise OutputError(f"{self._frame(index)} has changed meanwhile; run again")
        figures = json.loads(str(data["figures"]))
        diagnostics: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in figures["diagnostics"].items()
        }
        surfaces = [data[f"surface.{k}"] for k in range(sum(n.startswith("surface.") for n in data))]
        return StoredFrame(surfaces, Diagnostics(**diagnostics), figures["solve"], data.get("colliders"))

    def state(self) -> State:
        """The solver's state after the last of the `resumed` frames."""
        return self._state

    def save(self, index: int, frame: StoredFrame, state: State) -> None:
        figures = json.dumps({"diagnostics": asdict(frame.diagnostics), "solve": frame.solve})
        surfaces = {f"surface.{k}": s for k, s in enumerate(frame.surfaces)}
        _write(self._state_file(index), state)
        if frame.colliders is not None:
            surfaces["colliders"] = frame.colliders
        _write(self._frame(index), {"figures": np.array(figures), **surfaces})
        size = sum(array.nbytes for array in state.values())
        # The last two at least: a file may be cut off when a machine goes down.
        self._state_file(index - max(2, STATES // max(size, 1))).unlink(missing_ok=True)

    def finish(self) -> None:
        """The run is complete: nothing is left to resume."""
        try:
            shutil.rmtree(self.folder)
        except OSError as error:
            raise OutputError(f"{self.folder} cannot be removed: {error.strerror or error}") from None


def _read(path: Path) -> State | None:
    """All arrays of a file, or None, said aloud, where it is damaged."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        logger.warning("%s cannot be read (%s); continuing from an earlier frame", path, error)
        return None


def _write(path: Path, arrays: State) -> None:
    with atomic_write(path) as temporary:
        np.savez(temporary, **arrays)  # type: ignore[arg-type]


__all__ = ["Store", "StoredFrame"]
