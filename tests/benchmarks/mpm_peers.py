"""One run of another program's MPM, for `tests.benchmarks.bench_mpm_peers`.

    PYTHON tests/benchmarks/mpm_peers.py taichi|newton PROBLEM.npz SETTINGS

Needs no package of ours. PROBLEM.npz holds positions, velocities [N, 3] m and m/s, volume (m^3, of every
particle), dx (m) and gravity [3] m/s^2; SETTINGS is JSON. Prints one line of JSON.

taichi: MLS-MPM (Hu et al. 2018) as it is written in Taichi everywhere (mpm88, mpm99, taichi_elements), in
three dimensions: quadratic splines, a dense grid, one loop over particles each way, atomic sums. SETTINGS:
law, density, lam, mu (Pa), slope (of sand's cone), h (s), substeps, repeats, threads, and low, size (the
grid's first node and its nodes along each axis). Prints wall and processor seconds of each of `repeats` runs
of `substeps`, and the positions after the last, to the file named `out`.

newton: Newton's implicit MPM. SETTINGS: young, poisson, density, friction (of sand; null: elastic), ground
(friction of the floor z = 0), dt (s), steps, iterations. Prints wall and processor seconds of each step, and
the mean z and the extent (as `bench_mpm_peers` has it), m, of the particles of `top` [N] bool after each. A
step is run before, not counted, to compile.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np


def timed(work: Callable[[], None]) -> tuple[float, float]:
    """Wall and processor seconds."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - processor


def taichi_mls(problem: dict[str, Any], settings: dict[str, Any]) -> dict[str, Any]:
    import taichi as ti

    ti.init(arch=ti.cpu, cpu_max_num_threads=settings["threads"], default_fp=ti.f32, log_level=ti.ERROR)
    count, law = len(problem["positions"]), settings["law"]
    dx, h, volume = float(problem["dx"]), settings["h"], float(problem["volume"])
    mass, lam, mu = settings["density"] * volume, settings["lam"], settings["mu"]
    slope, inverse = settings["slope"], 1.0 / dx
    gravity = ti.Vector([float(g) for g in problem["gravity"]])
    x, v = (ti.Vector.field(3, ti.f32, count) for _ in range(2))
    C, F = (ti.Matrix.field(3, 3, ti.f32, count) for _ in range(2))
    J = ti.field(ti.f32, count)  # a fluid's; of sand the log of the volume gained
    grid_v = ti.Vector.field(3, ti.f32, settings["size"])
    grid_m = ti.field(ti.f32, settings["size"])

    @ti.func
    def stress(p):  # type: ignore[no-untyped-def]
        """Kirchhoff's, of F or J moved on by one substep."""
        identity = ti.Matrix.identity(ti.f32, 3)
        tau = ti.Matrix.zero(ti.f32, 3, 3)
        if ti.static(law == "fluid"):
            J[p] *= 1.0 + h * C[p].trace()
            tau = -J[p] * ti.max(lam / 7.0 * (J[p] ** -7 - 1.0), 0.0) * identity
        else:
            F[p] = (identity + h * C[p]) @ F[p]
            if ti.static(law == "neo_hookean"):
                tau = mu * (F[p] @ F[p].transpose() - identity)
                tau += lam * ti.log(F[p].determinant()) * identity
            else:
                U, s, V = ti.svd(F[p])
                if ti.static(law == "corotated"):
                    size = s[0, 0] * s[1, 1] * s[2, 2]
                    tau = 2.0 * mu * (F[p] - U @ V.transpose()) @ F[p].transpose()
                    tau += lam * size * (size - 1.0) * identity
                else:
                    # Klar et al. 2016, with the volume correction of Tampubolon et al. 2017.
                    e = ti.Vector([ti.log(s[0, 0]), ti.log(s[1, 1]), ti.log(s[2, 2])])
                    trace = e.sum()
                    dev = e - trace / 3.0
                    norm, opened = dev.norm() + 1e-20, trace + J[p]
                    if opened >= 0.0:
                        J[p], e = opened, ti.Vector.zero(ti.f32, 3)
                    else:
                        e += J[p] / 3.0
                        J[p] = 0.0
                        over = norm + (1.5 * lam / mu + 1.0) * opened * slope
                        if over > 0.0:
                            e -= over / norm * dev
                    tau_of = 2.0 * mu * e + lam * e.sum()
                    t, r = ti.Matrix.zero(ti.f32, 3, 3), ti.Matrix.zero(ti.f32, 3, 3)
                    for a in ti.static(range(3)):
                        t[a, a], r[a, a] = tau_of[a], ti.exp(e[a])
                    tau = U @ t @ U.transpose()
                    F[p] = U @ r @ V.transpose()
        return tau

    @ti.kernel
    def clear():  # type: ignore[no-untyped-def]
        for node in ti.grouped(grid_m):
            grid_v[node] = ti.Vector.zero(ti.f32, 3)
            grid_m[node] = 0.0

    @ti.kernel
    def scatter():  # type: ignore[no-untyped-def]
        for p in x:
            base = (x[p] * inverse - 0.5).cast(int)
            f = x[p] * inverse - base
            w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2]
            affine = mass * C[p] - (4.0 * h * volume * inverse * inverse) * stress(p)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                offset = ti.Vector([i, j, k])
                weight = w[i][0] * w[j][1] * w[k][2]
                grid_v[base + offset] += weight * (mass * v[p] + affine @ ((offset - f) * dx))
                grid_m[base + offset] += weight * mass

    @ti.kernel
    def move():  # type: ignore[no-untyped-def]
        for node in ti.grouped(grid_m):
            if grid_m[node] > 0.0:
                grid_v[node] = grid_v[node] / grid_m[node] + h * gravity

    @ti.kernel
    def gather():  # type: ignore[no-untyped-def]
        for p in x:
            base = (x[p] * inverse - 0.5).cast(int)
            f = x[p] * inverse - base
            w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2]
            new_v, new_C = ti.Vector.zero(ti.f32, 3), ti.Matrix.zero(ti.f32, 3, 3)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                offset = ti.Vector([i, j, k])
                part = w[i][0] * w[j][1] * w[k][2] * grid_v[base + offset]
                new_v += part
                new_C += 4.0 * inverse * part.outer_product(offset - f)
            v[p], C[p] = new_v, new_C
            x[p] += h * new_v

    def run(substeps: int) -> None:
        for _ in range(substeps):
            clear()
            scatter()
            move()
            gather()
        ti.sync()

    def reset() -> None:
        x.from_numpy((problem["positions"] - dx * np.array(settings["low"])).astype(np.float32))
        v.from_numpy(problem["velocities"].astype(np.float32))
        C.fill(0.0)
        F.from_numpy(np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)))
        J.fill(1.0 if law == "fluid" else 0.0)

    reset()
    run(2)
    times = []
    for _ in range(settings["repeats"]):
        reset()
        times.append(timed(lambda: run(settings["substeps"])))
    np.save(settings["out"], x.to_numpy() + dx * np.array(settings["low"]))
    return {"wall": [wall for wall, _ in times], "processor": [processor for _, processor in times]}


def newton_implicit(problem: dict[str, Any], settings: dict[str, Any]) -> dict[str, Any]:
    import newton
    import warp as wp
    from newton.solvers import SolverImplicitMPM

    count, volume = len(problem["positions"]), float(problem["volume"])
    builder = newton.ModelBuilder(gravity=tuple(float(g) for g in problem["gravity"]))
    SolverImplicitMPM.register_custom_attributes(builder)
    builder.add_particles(
        pos=[wp.vec3(*map(float, point)) for point in problem["positions"]],
        vel=[wp.vec3(*map(float, velocity)) for velocity in problem["velocities"]],
        mass=[settings["density"] * volume] * count,
        radius=[0.5 * volume ** (1.0 / 3.0)] * count,
    )
    builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=settings["ground"]))
    model = builder.finalize(device="cpu")
    material = model.mpm
    material.young_modulus.fill_(settings["young"])
    material.poisson_ratio.fill_(settings["poisson"])
    if settings["friction"] is None:
        material.tensile_yield_ratio.fill_(1.0)
    else:
        material.friction.fill_(settings["friction"])
    config = SolverImplicitMPM.Config(
        voxel_size=float(problem["dx"]), max_iterations=settings["iterations"], **settings["config"]
    )

    def start() -> tuple[Callable[[], None], list[Any]]:
        states = [model.state(), model.state()]
        solver = SolverImplicitMPM(model, config=config)

        def step() -> None:
            solver.step(states[0], states[1], None, None, settings["dt"])
            solver.project_outside(states[1], states[1], settings["dt"])
            states.reverse()

        return step, states

    start()[0]()
    step, states = start()
    heights, extents, walls, processors = [], [], [], []
    for _ in range(settings["steps"]):
        wall, processor = timed(step)
        walls.append(wall)
        processors.append(processor)
        found = states[0].particle_q.numpy()[problem["top"]]
        heights.append(float(found[:, 2].mean()))
        extents.append(float(np.ptp(np.percentile(found[:, :2], (1, 99), axis=0), axis=0).max()))
    return {"heights": heights, "extents": extents, "wall": walls, "processor": processors}


def main() -> None:
    name, path, text = sys.argv[1:]
    with np.load(path) as archive:
        problem = dict(archive)
    run = {"taichi": taichi_mls, "newton": newton_implicit}[name]
    print(json.dumps(run(problem, json.loads(text))))


if __name__ == "__main__":
    main()
