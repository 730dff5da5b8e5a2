"""Runs fTetWild in a process of its own: `python -m gdpro_sim.meshing.tetwild_worker in.npz out.npz`.

fTetWild can crash, run for ever or eat the memory on hostile input; here none of it reaches the caller. The
input holds `vertices` float64 [V, 3], `faces` int32 [F, 3], `coarsen`, `edge_length` and `epsilon` relative
to the bounding box's diagonal, `seconds` and `bytes`; the output holds `vertices` float64 [P, 3] and `tets`
int32 [T, 4].
"""

from __future__ import annotations

import ctypes
import sys
import types

import numpy as np

PR_SET_PDEATHSIG = 1


def import_pytetwild() -> types.ModuleType:
    """Import pytetwild, which imports pyvista without declaring or (for arrays) needing it.

    An empty module stands in where pyvista is not installed; drop this when upstream mends it.
    """
    import importlib
    import importlib.util

    if importlib.util.find_spec("pyvista") is None:
        sys.modules.setdefault("pyvista", types.ModuleType("pyvista"))
    return importlib.import_module("pytetwild")


def limit_self(seconds: int, memory: int) -> None:
    """Have the operating system end this process should its parent die before it (POSIX only)."""
    try:
        import resource
        import signal

        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which kills this process
        signal.alarm(seconds)
        if sys.platform == "linux":
            ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    except (ImportError, AttributeError, ValueError, OSError):
        pass


def main(source: str, target: str) -> None:
    """Read the input file, tetrahedralize, write the output file."""
    with np.load(source, allow_pickle=False) as data:
        limit_self(int(data["seconds"]), int(data["bytes"]))
        vertices, tets = import_pytetwild().tetrahedralize(
            np.ascontiguousarray(data["vertices"], np.float64),
            np.ascontiguousarray(data["faces"], np.int32),
            edge_length_fac=float(data["edge_length"]),
            epsilon=float(data["epsilon"]),
            vtk_ordering=True,
            coarsen=bool(data["coarsen"]),
            quiet=True,
        )[:2]
    np.savez(target, vertices=np.asarray(vertices, np.float64), tets=np.asarray(tets, np.int32))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
