"""Preconditioned conjugate gradients on the fixed block rows.

Up to `SERIAL_ROWS` rows on a CPU the preconditioner is a symmetric block Gauss-Seidel sweep, on one thread;
beyond that, and on a GPU, it is block Jacobi, spread over all of them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from gdpro_sim.device import Launches
from gdpro_sim.kernels import gauss_seidel, linalg
from gdpro_sim.simulation.fem.topology import Topology

ROW_BLOCKS = 128
"""Partial sums of one dot product: fixed, so that its value does not depend on the number of threads."""

SERIAL_ROWS = 24576
"""Up to this many rows one thread with a third of the iterations beats Jacobi on 2 cores."""

CUDA_CHECK_EVERY = 16
"""On CUDA the host looks at the residual only so often; steps past convergence change nothing."""


class SolveReport(NamedTuple):
    """`definite` is False where a direction without positive curvature ended the solve."""

    iterations: int
    converged: bool
    definite: bool


class ConjugateGradient:
    """Solves A x = b; holds A's values and every work vector, so a solve allocates nothing.

    values:            [N] mat33d entries of A in the order of `Topology.columns`
    inverse_diagonal:  [P] mat33d inverses of the diagonal blocks, for the preconditioner; zero keeps a row's
                       solution at zero
    right_hand_side:   [P] vec3d
    solution:          [P] vec3d
    residual:          [P] vec3d, b - A x of the last solve as the recurrence carries it
    six:               [P, 3, 6] float64 NumPy, zero at first: what `product_six` multiplies
    """

    def __init__(self, topology: Topology, device: str) -> None:
        self.device = device
        self.rows = len(topology.offsets) - 1
        self.serial = device == "cpu" and self.rows <= SERIAL_ROWS
        self.blocks = min(ROW_BLOCKS, self.rows) if device == "cpu" else self.rows
        self.offsets: wp.array = wp.array(topology.offsets, dtype=wp.int32, device=device)
        self.columns: wp.array = wp.array(topology.columns, dtype=wp.int32, device=device)
        self._diagonal: wp.array = wp.array(topology.diagonal, dtype=wp.int32, device=device)
        self._work = wp.zeros(
            gauss_seidel.WORK * self.rows if self.serial else 0, dtype=wp.float64, device=device
        )
        self.values = wp.zeros(len(topology.columns), dtype=wp.mat33d, device=device)
        self._extra_offsets = wp.zeros(self.rows + 1, dtype=wp.int32, device=device)
        self._extra_columns = wp.zeros(0, dtype=wp.int32, device=device)
        self._extra_values = wp.zeros(0, dtype=wp.mat33d, device=device)
        self._coupled = False
        self._forward = self._transposed = wp.zeros(0, dtype=wp.vec3d, device=device)
        self._curvature = self._change = wp.zeros(0, dtype=wp.float64, device=device)
        self.inverse_diagonal = wp.zeros(self.rows, dtype=wp.mat33d, device=device)
        self.right_hand_side, self.solution, self.residual, self._z, self._p, self._q = (
            wp.zeros(self.rows, dtype=wp.vec3d, device=device) for _ in range(6)
        )
        self._six, self._product_six = (
            wp.zeros(24 * self.rows, dtype=wp.float64, device=device) for _ in range(2)
        )
        # On the CPU this is the array's own memory.
        self._padded = self._six.numpy().reshape(self.rows, 3, 8)
        self.six = self._padded[..., :6]
        self._dots = wp.zeros(self.blocks, dtype=wp.float64, device=device)
        self._sums = wp.zeros(ROW_BLOCKS, dtype=wp.float64, device=device)
        self._scalars = wp.zeros(8, dtype=wp.float64, device=device)
        self._tolerance = wp.zeros(1, dtype=wp.float64, device=device)
        if device == "cpu":
            # Before several threads could each try to build it.
            wp.load_module(linalg, device=device)
        self._launch = Launches(device)

    def couple(self, blocks: Any | None) -> None:
        """Add off-diagonal blocks, a symmetric scipy.sparse.bsr_matrix of 3x3 blocks over all rows, to A.

        They stay until the next call; None takes them out. Memory grows with the most blocks seen.
        """
        if blocks is None:
            if self._coupled:
                self._extra_offsets.zero_()
                self._coupled = False
            return
        count = len(blocks.indices)
        if count > len(self._extra_columns):
            self._extra_columns = wp.zeros(2 * count, dtype=wp.int32, device=self.device)
            self._extra_values = wp.zeros(2 * count, dtype=wp.mat33d, device=self.device)
        self._extra_offsets.assign(np.ascontiguousarray(blocks.indptr, np.int32))
        if count:
            columns: wp.array = wp.array(blocks.indices.astype(np.int32), dtype=wp.int32, device=self.device)
            values: wp.array = wp.array(
                np.ascontiguousarray(blocks.data), dtype=wp.mat33d, device=self.device
            )
            wp.copy(self._extra_columns, columns, count=count)
            wp.copy(self._extra_values, values, count=count)
        self._coupled = True

    def average(self, forward: wp.array, transposed: wp.array, curvature: wp.array) -> None:
        """Add G^T D G to A, factor by factor, for good; the arrays are read anew in every solve.

        forward, transposed: [N + 1] vec3d, G (row by row) and its transpose, in the order of
                             `Topology.columns`; the last is not used, but read
        curvature:           [P] D
        """
        self._forward, self._transposed, self._curvature = forward, transposed, curvature
        self._change = wp.zeros(self.rows, dtype=wp.float64, device=self.device)

    def product(self, x: np.ndarray) -> np.ndarray:
        """A x for x [P, 3], float64."""
        found = (self.matrix() @ x.reshape(-1)).reshape(-1, 3)
        if len(self._change):
            offsets, columns = self.offsets.numpy(), self.columns.numpy()
            rows = np.repeat(np.arange(self.rows), np.diff(offsets))
            change = np.bincount(rows, (self._forward.numpy()[:-1] * x[columns]).sum(1), self.rows)
            change *= self._curvature.numpy()
            back = self._transposed.numpy()[:-1] * change[columns, None]
            found += np.stack([np.bincount(rows, back[:, k], self.rows) for k in range(3)], 1)
        return found

    def product_six(self) -> np.ndarray:
        """A without G^T D G times `six`, [P, 3, 6] float64, what it is until the next call."""
        if self.device != "cpu":
            self._six.assign(self._padded.reshape(-1))
        inputs = [self.offsets, self.columns, self.values]
        inputs += [self._extra_offsets, self._extra_columns, self._extra_values, self._six]
        self._launch(linalg.product_six, self.rows, inputs, [self._product_six])
        return self._product_six.numpy().reshape(self._padded.shape)[..., :6]

    def solve(self, tolerance: float, max_iterations: int) -> SolveReport:
        """Solve until the preconditioned residual has fallen by `tolerance`, starting from zero."""
        if self.serial:
            self._solve_serial(tolerance, max_iterations)
        else:
            self._solve_phases(tolerance, max_iterations)
        scalars = self._scalars.numpy()
        done = float(scalars[linalg.CG_DONE])
        return SolveReport(int(scalars[linalg.CG_ITERATIONS]), done > 0.0, done >= 0.0)

    def _solve_serial(self, tolerance: float, max_iterations: int) -> None:
        self._launch(
            gauss_seidel.gauss_seidel_cg,
            1,
            [
                self.rows,
                max_iterations,
                tolerance,
                self._coupled,
                self.offsets,
                self.columns,
                self._diagonal,
                self.values,
                self._extra_offsets,
                self._extra_columns,
                self._extra_values,
                self._forward,
                self._curvature,
                self.inverse_diagonal,
                self.right_hand_side,
            ],
            [self._work, self.residual, self.solution, self._scalars],
        )

    def _solve_phases(self, tolerance: float, max_iterations: int) -> None:
        self._over_rows(
            linalg.cg_reset,
            [self.right_hand_side, self.inverse_diagonal],
            [self.solution, self.residual, self._z, self._p, self._dots],
        )
        self._scalar(linalg.cg_begin)
        self._tolerance.fill_(tolerance)
        check_every = 1 if self.device == "cpu" else CUDA_CHECK_EVERY
        for iteration in range(max_iterations):
            if iteration % check_every == 0 and self._scalars.numpy()[linalg.CG_DONE] != 0.0:
                break
            self._over_rows(linalg.cg_direction, [self._z, self._scalars], [self._p])
            if len(self._change):
                inputs = [self.offsets, self.columns, self._forward, self._curvature, self._p]
                self._over_rows(linalg.cg_change, inputs, [self._change])
            self._over_rows(
                linalg.cg_product,
                [
                    self.offsets,
                    self.columns,
                    self.values,
                    self._extra_offsets,
                    self._extra_columns,
                    self._extra_values,
                    self._transposed,
                    self._change,
                    self._p,
                ],
                [self._q, self._dots],
            )
            self._scalar(linalg.cg_set_alpha)
            self._over_rows(
                linalg.cg_update,
                [self._p, self._q, self.inverse_diagonal, self._scalars],
                [self.solution, self.residual, self._z, self._dots],
            )
            self._scalar(linalg.cg_set_beta)

    def _over_rows(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        minimum = ROW_BLOCKS // 16
        self._launch(kernel, self.blocks, [self.rows, self.blocks, *inputs], outputs, minimum=minimum)

    def _scalar(self, kernel: wp.Kernel) -> None:
        """One of the scalar steps, over the partial sums of the phase before it."""
        dots, count = self._dots, self.blocks
        if self.device != "cpu":
            sums = [self._sums]
            self._launch(linalg.sum_ranges, ROW_BLOCKS, [count, ROW_BLOCKS, dots], sums)
            dots, count = self._sums, ROW_BLOCKS
        self._launch(kernel, 1, [count, dots, self._tolerance], [self._scalars])

    def matrix(self) -> Any:
        """A without G^T D G as a scipy BSR matrix.

        On the CPU it shares the memory of `values` where nothing is coupled.
        """
        from scipy.sparse import bsr_matrix

        count = 3 * self.rows
        parts = (self.values.numpy(), self.columns.numpy(), self.offsets.numpy())
        found = bsr_matrix(parts, shape=(count, count), copy=False)
        if not self._coupled:
            return found
        offsets = self._extra_offsets.numpy()
        end = int(offsets[-1])
        parts = (self._extra_values.numpy()[:end], self._extra_columns.numpy()[:end], offsets)
        return found + bsr_matrix(parts, shape=(count, count))


__all__ = ["ConjugateGradient", "SolveReport"]
