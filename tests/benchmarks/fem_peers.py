"""One run of another program's soft-body solver, for `tests.benchmarks.bench_fem_peers`.

    PYTHON tests/benchmarks/fem_peers.py newton|mujoco MESH.npz SETTINGS

Needs no package of ours. MESH.npz holds vertices [P, 3] m, tets [T, 4], pinned and tip [P] bool, young,
poisson, density, gravity (m/s^2, downward), ground (a floor at z = 0); SETTINGS is JSON: frames, substeps,
iterations. Prints one line of JSON: the mean z, m, of the vertices of `tip` after each frame (1/60 s), and
wall and processor milliseconds of each frame. A frame is run before, not counted, to compile.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

FRAME = 1.0 / 60.0


def lame(young: float, poisson: float) -> tuple[float, float]:
    return young / (2.0 * (1.0 + poisson)), young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))


def newton_vbd(mesh: dict[str, Any], substeps: int, iterations: int) -> tuple[Callable[[], None], Any]:
    """Newton's vertex block descent."""
    import newton
    import warp as wp

    mu, lam = lame(float(mesh["young"]), float(mesh["poisson"]))
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -float(mesh["gravity"])))
    builder.add_soft_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*map(float, v)) for v in mesh["vertices"]],
        indices=mesh["tets"].reshape(-1).tolist(),
        density=float(mesh["density"]),
        k_mu=mu,
        k_lambda=lam,
        k_damp=0.0,
        add_surface_mesh_edges=False,
        particle_radius=1e-3,
    )
    for i in np.flatnonzero(mesh["pinned"]):
        builder.particle_mass[i] = 0.0
        builder.particle_flags[i] = int(builder.particle_flags[i]) & ~int(newton.ParticleFlags.ACTIVE)
    if mesh["ground"]:
        builder.add_ground_plane()
    builder.color()
    model = builder.finalize(device="cpu")
    solver = newton.solvers.SolverVBD(model, iterations=iterations, particle_enable_self_contact=False)
    states, control = [model.state(), model.state()], model.control()
    contacts = model.contacts() if mesh["ground"] else None

    def step() -> None:
        for _ in range(substeps):
            states[0].clear_forces()
            if contacts is not None:
                model.collide(states[0], contacts)
            solver.step(states[0], states[1], control, contacts, FRAME / substeps)
            states.reverse()

    return step, lambda: states[0].particle_q.numpy()


def mujoco_flex(mesh: dict[str, Any], substeps: int, iterations: int) -> tuple[Callable[[], None], Any]:
    """MuJoCo's flex with every vertex free: discrete integrator, conjugate gradients, stable neo-Hookean."""
    import mujoco

    points = " ".join(f"{v:.9g}" for v in mesh["vertices"].reshape(-1))
    elements = " ".join(map(str, mesh["tets"].reshape(-1)))
    pins = " ".join(map(str, np.flatnonzero(mesh["pinned"])))
    pin = f'<pin id="{pins}"/>' if pins else ""
    floor = '<geom type="plane" size="5 5 .1" friction="0.5 0.005 0.0001"/>' if mesh["ground"] else ""
    text = f"""<mujoco>
      <option integrator="discrete" solver="CG" timestep="{FRAME / substeps!r}" iterations="{iterations}"
              gravity="0 0 {-float(mesh["gravity"])!r}"><flag diagexact="enable"/></option>
      <size memory="4G"/>
      <worldbody>{floor}
        <flexcomp name="body" type="direct" dim="3" dof="full" mass="1" radius="0.001"
                  point="{points}" element="{elements}">
          {pin}
          <contact condim="3" selfcollide="none" solref="0.01 1"/>
          <elasticity young="{float(mesh["young"])!r}" poisson="{float(mesh["poisson"])!r}" damping="0"/>
        </flexcomp>
      </worldbody>
    </mujoco>"""
    spec = mujoco.MjSpec.from_string(text)
    spec.flexes[0].elastic3d = 1
    model = spec.compile()
    data = mujoco.MjData(model)

    # A point's mass is a quarter of its elements', as in the other solvers, not an equal share.
    corners = mesh["vertices"].astype(float)[mesh["tets"]]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6.0
    count = len(mesh["vertices"])
    masses = np.zeros(count)
    np.add.at(masses, mesh["tets"], float(mesh["density"]) * volumes[:, None] / 4.0)
    bodies = model.flex_vertbodyid
    free = np.flatnonzero(~mesh["pinned"])
    share = masses[free] / model.body_mass[bodies[free]]
    model.body_inertia[bodies[free]] *= share[:, None]
    model.body_mass[bodies[free]] = masses[free]
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetData(model, data)

    def step() -> None:
        for _ in range(substeps):
            mujoco.mj_step(model, data)

    return step, lambda: data.flexvert_xpos


def main() -> None:
    name, path, text = sys.argv[1:]
    settings = json.loads(text)
    with np.load(path) as archive:
        mesh = dict(archive)
    make = {"newton": newton_vbd, "mujoco": mujoco_flex}[name]
    make(mesh, settings["substeps"], settings["iterations"])[0]()
    step, positions = make(mesh, settings["substeps"], settings["iterations"])
    heights, walls, processors = [], [], []
    for _ in range(settings["frames"]):
        wall, processor = time.perf_counter(), time.process_time()
        step()
        processors.append(1e3 * (time.process_time() - processor))
        walls.append(1e3 * (time.perf_counter() - wall))
        heights.append(float(np.asarray(positions()).reshape(-1, 3)[mesh["tip"], 2].mean()))
    print(json.dumps({"heights": heights, "wall": walls, "processor": processors}))


if __name__ == "__main__":
    main()
