"""Several solvers in one scene, stepped in turns until they agree (strong staggered coupling).

In a step of the coupling MuJoCo says where its bodies go; soft bodies meet them on that way and say what
impulses they gave; MuJoCo steps again, from the same state, with those. Where the bodies went otherwise than
the soft ones were told, the way is corrected and the soft solvers step again. What rigid bodies get is always
exactly what soft ones gave: the momentum of the whole is kept however well the ways agree.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from gdpro_sim.errors import SolverError
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import Guide, Pose
from gdpro_sim.simulation.coupled.quasi_newton import QuasiNewton
from gdpro_sim.simulation.model import Coupling, Diagnostics, Model, PartName, Solver
from gdpro_sim.simulation.mujoco import SolverMuJoCo

log = logging.getLogger(__name__)

SUMMED = (
    "kinetic_energy", "elastic_energy", "gravity_energy", "contact_energy", "force_energy", "contacts",
)  # fmt: skip

COUNTED = ("substeps", "newton_iterations", "cg_iterations")


MAX_SPLITS = 4
"""A step of the coupling in which the solvers do not agree is halved at most this many times."""


class SoftSolver(Solver, Protocol):
    """FEM or MPM."""

    def collider_impulses(self) -> np.ndarray:
        """[C, 6] N s and N m s about the world's origin that bodies gave each collider in the last step."""


@dataclass
class _Counters:
    """Of the last `step`, over its parts."""

    substeps: int = 0
    newton_iterations: int = 0
    cg_iterations: int = 0
    converged: bool = True
    residual: float = 0.0
    rounds: int = 0


class SolverCoupled:
    """MuJoCo's rigid bodies and the soft ones of FEM and MPM; implements `Solver`.

    model:   with a `Coupling`
    solvers: of each part
    rigid:   MuJoCo's

    Raises SceneError or SolverError where a part cannot simulate what it has.
    """

    def __init__(self, model: Model) -> None:
        assert model.coupling is not None
        self.model = model
        self.coupling: Coupling = model.coupling
        parts = self.coupling.parts
        self.rigid = SolverMuJoCo(parts["mujoco"])
        self.solvers: dict[PartName, Solver] = {"mujoco": self.rigid}
        self._numbers = np.array(
            [
                link.body if link.of_base else self.rigid.mjmodel.body(self.rigid.world.names[link.body]).id
                for link in self.coupling.links
            ],
            np.int64,
        )
        self._turns, self._centres = self.rigid.frames(self._numbers)
        self._guides = [Guide(centre) for centre in self._centres]
        owners = [k for k, link in enumerate(self.coupling.links) for _ in link.colliders]
        guided = tuple(
            replace(collider, motion=guide)
            for link, guide in zip(self.coupling.links, self._guides, strict=True)
            for collider in link.colliders
        )
        self._gather = np.zeros((len(self._guides), len(guided)))
        self._gather[owners, np.arange(len(guided))] = 1.0
        self._soft: dict[PartName, SoftSolver] = {}
        for part in ("fem", "mpm"):
            if part in parts:
                whole = replace(parts[part], colliders=(*parts[part].colliders, *guided))
                self._soft[part] = self.solvers[part] = _soft_solver(part, whole)
        mass, inertia = (
            np.asarray(array)[self._numbers]
            for array in (self.rigid.mjmodel.body_mass, self.rigid.mjmodel.body_inertia)
        )
        radius = np.sqrt(inertia.max(axis=1, initial=0.0) / np.maximum(mass, 1e-300))
        self._scale = np.repeat(np.stack([np.ones_like(radius), radius], axis=1), 3, axis=1)
        self._push = np.zeros((len(self._guides), 6))
        self._impulses: dict[PartName, np.ndarray] = {}
        self._time = 0.0
        self._counters = _Counters()
        self.reset()

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self._time

    @property
    def rounds(self) -> int:
        """How often soft bodies were stepped in the last step, over the steps of the coupling."""
        return self._counters.rounds

    @property
    def links(self) -> tuple[Collider, ...]:
        """What pictures show of MuJoCo's base."""
        return self.rigid.links

    def link_poses(self) -> np.ndarray:
        """Where `links` are, [L, 3, 4]."""
        return self.rigid.link_poses()

    def collider_impulses(self, part: PartName) -> np.ndarray:
        """[C, 6] N s and N m s about the world's origin that bodies of "fem" or "mpm" gave in the last step.

        To the colliders of that part's model, and then to those of the links; 0 before any step, and
        for those that no `Guide` moves.
        """
        impulses: np.ndarray = self._impulses.get(part, np.zeros_like(self._soft[part].collider_impulses()))
        return impulses

    # ---- Solver ----

    def reset(self) -> None:
        """Back to the model's initial state."""
        self.rigid.reset()
        self._push[:] = 0.0
        self._impulses = {}
        self._time = 0.0
        self._counters = _Counters()
        self._stand()
        for solver in self._soft.values():
            solver.reset()

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds, in equal steps of the coupling no longer than its `step`.

        Raises SolverError, leaving the state as it was, where a part cannot.
        """
        if not (math.isfinite(dt) and dt > 0.0):
            raise SolverError(f"step length must be a finite number > 0 s, got {dt}")
        before = self.state_dict()
        count = max(1, math.ceil(dt / self.coupling.step - 1e-9))
        begin, impulses = self._time, self._impulses
        self._counters, self._impulses = _Counters(), {}
        try:
            for k in range(count):
                self._advance(dt / count)
                self._time = begin + (k + 1) * dt / count
        except BaseException:  # Ctrl-C too: half a step is no state to continue from
            self.load_state_dict(before)
            self._impulses = impulses
            raise
        if not self._counters.converged:
            log.warning(
                "coupled step to t = %.6g s did not converge: what soft bodies met moved otherwise by "
                "%.3g m/s (tolerance %.3g)", self._time, self._counters.residual, self.coupling.tolerance,
            )  # fmt: skip

    def surface_positions(self, body: int) -> np.ndarray:
        """Deformed surface vertices of body number `body`, [V, 3] float32 m, world."""
        part, number = self.coupling.places[body]
        return self.solvers[part].surface_positions(number)

    def state_dict(self) -> dict[str, np.ndarray]:
        """Everything needed to continue to the same bytes: the parts' states by their names, and its own."""
        c = self._counters
        counters = [getattr(c, field.name) for field in fields(c)]
        state = {"time": np.array(self._time), "push": self._push.copy(), "counters": np.array(counters)}
        for part, solver in self.solvers.items():
            state.update({f"{part}.{name}": value for name, value in solver.state_dict().items()})
        return state

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state_dict`. Raises SolverError for one of another model."""
        for name, shape in {"time": (), "push": self._push.shape, "counters": (6,)}.items():
            if name not in state or np.shape(state[name]) != shape:
                raise SolverError(f"the state has no fitting {name!r}: it belongs to another model")
        self.rigid.load_state_dict(_part_of(state, "mujoco"))
        self._push = np.array(state["push"], np.float64)
        self._time = float(state["time"])
        substeps, newton, cg, converged, residual, rounds = np.asarray(state["counters"]).tolist()
        self._counters = _Counters(
            int(substeps), int(newton), int(cg), bool(converged), residual, int(rounds)
        )
        self._stand()
        for part, soft in self._soft.items():
            soft.load_state_dict(_part_of(state, part))

    def diagnostics(self) -> Diagnostics:
        """Sums over the parts; converged where every part and their agreement did in every step.

        residual: m/s, by which rigid bodies moved otherwise than what soft ones met, at most
        """
        found = [solver.diagnostics() for solver in self.solvers.values()]
        c = self._counters
        values: dict[str, Any] = {key: sum(getattr(item, key) for item in found) for key in SUMMED}
        for key in ("momentum", "angular_momentum"):
            values[key] = tuple(float(x) for x in np.sum([getattr(item, key) for item in found], axis=0))
        return Diagnostics(
            time=self._time,
            max_penetration=max(item.max_penetration for item in found),
            min_volume_ratio=min(item.min_volume_ratio for item in found),
            converged=c.converged,
            residual=c.residual,
            **{key: getattr(c, key) for key in COUNTED},
            **values,
        )

    # ---- a step of the coupling ----

    def _advance(self, h: float, splits: int = 0) -> None:
        """Step all parts by `h` seconds, in halves where they do not agree or soft bodies cannot follow."""
        before = [solver.state_dict() for solver in self.solvers.values()]
        push, start = self._push, self._poses()
        try:
            residual = self._agree(h, start, before)
        except SolverError:
            if splits == MAX_SPLITS:
                raise
            residual = math.inf
        agreed = residual <= self.coupling.tolerance
        if not agreed and splits < MAX_SPLITS:
            log.debug("coupled step of %.3g s failed (%.3g m/s off): halved", h, residual)
            self.rigid.load_state_dict(before[0])
            self._restore_soft(start, before)
            self._push = push
            self._advance(0.5 * h, splits + 1)
            self._advance(0.5 * h, splits + 1)
            return
        self._time += h
        for part, soft in self._soft.items():
            self._impulses[part] = self._impulses.get(part, 0.0) + soft.collider_impulses()
        c = self._counters
        c.converged &= agreed
        c.residual = max(c.residual, residual)
        for solver in self.solvers.values():
            item = solver.diagnostics()
            for key in COUNTED:
                setattr(c, key, getattr(c, key) + getattr(item, key))
            c.converged &= item.converged

    def _agree(self, h: float, start: list[Pose], before: list[dict[str, np.ndarray]]) -> float:
        """Step all parts by `h` seconds, at most `iterations` times; m/s by which ways differ in the end."""
        self._move_rigid(h)  # pushed as in the step before
        guess = self._way(start)
        relaxation = QuasiNewton(guess.size)
        residual = math.inf
        for k in range(self.coupling.iterations):
            if k > 0:
                self._restore_soft(start, before)
            self._tell(start, self._moved(start, guess), h)
            for solver in self._soft.values():
                solver.step(h)
            self.rigid.load_state_dict(before[0])
            self._push = self._pushes(h, start, guess)
            self._move_rigid(h)
            found = self._way(start)
            off = self._scale * (found - guess)
            residual = float(np.linalg.norm(off.reshape(-1, 3), axis=1).max(initial=0.0)) / h
            self._counters.rounds += 1
            if residual <= self.coupling.tolerance:
                break
            scaled = relaxation.next((self._scale * guess).ravel(), (self._scale * found).ravel())
            guess = scaled.reshape(-1, 6) / np.maximum(self._scale, 1e-300)
        return residual

    def _restore_soft(self, start: list[Pose], before: list[dict[str, np.ndarray]]) -> None:
        self._tell(start, start)
        for solver, state in zip(self._soft.values(), before[1:], strict=True):
            solver.load_state_dict(state)

    def _move_rigid(self, h: float) -> None:
        self.rigid.wrenches[self._numbers] = self._push
        self.rigid.step(h)

    def _pushes(self, h: float, start: list[Pose], way: np.ndarray) -> np.ndarray:
        """Forces and moments [B, 6] about the centres of mass that give rigid bodies in `h` s what they got.

        MuJoCo adds a moment where the body is at the beginning of each of its own steps.
        """
        total = np.zeros((len(self._guides), 6))
        for solver in self._soft.values():
            given = solver.collider_impulses()
            total += self._gather @ given[len(given) - self._gather.shape[1] :]
        count = self.rigid.substeps(h)
        centres = self._centres_of(start) + 0.5 * (count - 1) / count * way[:, :3]
        total[:, 3:] -= np.cross(centres, total[:, :3])
        return total / h

    def _poses(self) -> list[Pose]:
        """Where rigid bodies are, as the motions of their guides."""
        turns, centres = self.rigid.frames(self._numbers)
        poses = []
        for turn, centre, first, at in zip(turns, centres, self._turns, self._centres, strict=True):
            turned = turn @ first.T
            poses.append((turned, centre - turned @ at))
        return poses

    def _centres_of(self, poses: list[Pose]) -> np.ndarray:
        return np.array(
            [turn @ at + shift for (turn, shift), at in zip(poses, self._centres, strict=True)]
        ).reshape(-1, 3)

    def _way(self, start: list[Pose]) -> np.ndarray:
        """Shifts in m of the centres and rotation vectors in rad since `start`, [B, 6]."""
        now = self._poses()
        shifts = self._centres_of(now) - self._centres_of(start)
        turns = np.array(
            [Rotation.from_matrix(b @ a.T).as_rotvec() for (a, _), (b, _) in zip(start, now, strict=True)]
        ).reshape(-1, 3)
        return np.hstack([shifts, turns])

    def _moved(self, start: list[Pose], way: np.ndarray) -> list[Pose]:
        """Poses after a way [B, 6], as `_way` says it."""
        moved = []
        for (turn, _), centre, at, step in zip(
            start, self._centres_of(start), self._centres, way, strict=True
        ):
            turned = Rotation.from_rotvec(step[3:]).as_matrix() @ turn
            moved.append((turned, centre + step[:3] - turned @ at))
        return moved

    def _tell(self, start: list[Pose], end: list[Pose], h: float = 0.0) -> None:
        for guide, before, after in zip(self._guides, start, end, strict=True):
            guide.tell(self._time, self._time + h, before, after)

    def _stand(self) -> None:
        """Tell guides that rigid bodies are where they are."""
        poses = self._poses()
        self._tell(poses, poses)


def _soft_solver(part: PartName, model: Model) -> SoftSolver:
    # Imported here: each compiles kernels of its own.
    if part == "mpm":
        from gdpro_sim.simulation.mpm import SolverMPM

        return SolverMPM(model)
    from gdpro_sim.simulation.fem import SolverFEM

    return SolverFEM(model)


def _part_of(state: dict[str, np.ndarray], part: str) -> dict[str, np.ndarray]:
    """What a state holds of one part."""
    prefix = f"{part}."
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


__all__ = ["SolverCoupled"]
