"""Runs CoACD in a process of its own: `python -m gdpro_sim.meshing.convex_worker in.npz out.npz`.

CoACD is native code, prints what it does, and can run for a long time. The input holds `vertices` float64
[V, 3], `faces` int32 [F, 3], `threshold`, `most` (pieces; -1 for any number), `seed` and `seconds`; the
output holds the pieces' `vertices` float64 [P, 3], piece after piece, and `counts` int64 [n] of them.
"""

from __future__ import annotations

import sys

import numpy as np

from gdpro_sim.meshing.tetwild_worker import limit_self

MEMORY = 16 << 30


def main(source: str, target: str) -> None:
    """Read the input file, decompose, write the output file."""
    import coacd

    with np.load(source, allow_pickle=False) as data:
        limit_self(int(data["seconds"]), MEMORY)
        coacd.set_log_level("error")
        mesh = coacd.Mesh(np.asarray(data["vertices"], np.float64), np.asarray(data["faces"], np.int32))
        pieces = coacd.run_coacd(
            mesh,
            threshold=float(data["threshold"]),
            max_convex_hull=int(data["most"]),
            seed=int(data["seed"]),
            resolution=1000,
            mcts_nodes=12,
            mcts_iterations=60,
            preprocess_resolution=40,
            decimate=True,
            max_ch_vertex=64,
        )
    vertices = [np.asarray(v, np.float64).reshape(-1, 3) for v, _ in pieces]
    np.savez(
        target,
        vertices=np.concatenate([np.zeros((0, 3)), *vertices]),
        counts=np.array([len(v) for v in vertices], np.int64),
    )


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
