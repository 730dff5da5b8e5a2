"""Settings of the solvers, as a scene describes them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from gdpro_sim.simulation.animation_options import AnimationOptions
from gdpro_sim.simulation.model import Coupling, FemSettings, Integrator, MpmSettings
from gdpro_sim.simulation.mujoco_options import MujocoOptions
from gdpro_sim.simulation.options import Options, Vector


class FemOptions(Options):
    """Settings of the FEM solver; the defaults are converged for the shipped scenes."""

    kind: Literal["fem"] = "fem"
    integrator: Integrator = Field(
        default="backward-euler",
        description="backward-euler; bdf2 or midpoint, which damp less; quasi-static; explicit",
    )
    substeps: int = Field(default=2, ge=1, le=1000, description="implicit steps per frame at least")
    newton_iterations: int = Field(default=60, ge=1, le=1000, description="at most, per substep")
    newton_tolerance: float = Field(default=1e-3, gt=0.0, description="largest vertex speed correction, m/s")
    cg_iterations: int = Field(default=2000, ge=1, description="at most, per Newton iteration")
    cg_tolerance: float = Field(
        default=1e-2, gt=0.0, lt=1.0, description="relative residual of inner conjugate gradients"
    )
    contact_stiffness: float = Field(
        default=1.0, gt=0.0, description="multiple of the automatic ground stiffness"
    )
    volumes: Literal["auto", "nodal", "element"] = Field(
        default="auto",
        description="volume changes: averaged around vertices, per element, or by Poisson ratio",
    )
    contact_gap: float = Field(
        default=FemSettings.contact_gap,
        gt=0.0,
        lt=0.1,
        description="distance kept between bodies, as a fraction of the smallest one's size",
    )
    body_contact: bool = Field(
        default=FemSettings.body_contact, description="whether bodies collide with each other"
    )
    self_contact: bool = Field(
        default=FemSettings.self_contact, description="whether bodies collide with themselves"
    )

    def settings(self) -> FemSettings:
        """For the compiled model."""
        return FemSettings(**{k: v for k, v in self.model_dump().items() if k != "kind"})


class MpmOptions(Options):
    """Settings of the MPM solver, and how its particles fill the bodies."""

    kind: Literal["mpm"] = "mpm"
    integrator: Literal["explicit", "implicit"] = Field(
        default=MpmSettings.integrator,
        description="explicit substeps as short as sound asks for; implicit, for stiff elastic bodies",
    )
    particles: int | None = Field(
        default=None, ge=100, le=20_000_000,
        description="to aim for, of all bodies together; default: 30,000, or what fits grid_spacing",
    )  # fmt: skip
    particles_per_cell: float = Field(default=8.0, ge=1.0, le=64.0, description="of the grid, inside a body")
    fill: Literal["jittered", "lattice", "blue-noise"] = Field(
        default="jittered", description="pattern of the particles at the start"
    )
    grid_spacing: float | None = Field(
        default=None, gt=0.0, description="m, edge of a cell; default: from the particles"
    )
    kernel: Literal["quadratic", "cubic"] = Field(
        default=MpmSettings.kernel, description="B-splines; cubic is smoother and takes longer"
    )
    transfer: Literal["apic", "pic", "flip"] = Field(
        default=MpmSettings.transfer,
        description="apic keeps angular momentum, pic damps, flip keeps what is left, noise included",
    )
    flip_ratio: float = Field(
        default=MpmSettings.flip_ratio, ge=0.0, le=1.0, description="share of flip, the rest is apic"
    )
    cfl: float = Field(
        default=MpmSettings.cfl, gt=0.0, le=1.0,
        description="cells that sound and particles may cross in a substep",
    )  # fmt: skip
    max_substeps: int = Field(default=MpmSettings.max_substeps, ge=1, description="per frame, at most")
    substeps: int = Field(
        default=MpmSettings.substeps, ge=1, le=1000, description="implicit steps per frame at least"
    )
    newton_iterations: int = Field(
        default=MpmSettings.newton_iterations, ge=1, le=1000, description="at most, per implicit substep"
    )
    newton_tolerance: float = Field(
        default=MpmSettings.newton_tolerance, gt=0.0, description="largest node speed correction, m/s"
    )
    cg_iterations: int = Field(
        default=MpmSettings.cg_iterations, ge=1, description="at most, per Newton iteration"
    )
    cg_tolerance: float = Field(
        default=MpmSettings.cg_tolerance, gt=0.0, lt=1.0,
        description="relative residual of inner conjugate gradients",
    )  # fmt: skip
    domain: tuple[Vector, Vector] | None = Field(
        default=None, description="lower and upper corner of a closed box, m; default: no walls"
    )
    max_cells: int = Field(
        default=MpmSettings.max_cells, ge=1, description="of the box around all particles, at most"
    )

    @field_validator("domain")
    @classmethod
    def _ordered(cls, value: Any) -> Any:
        if value is not None and any(b <= a for a, b in zip(*value, strict=True)):
            low, high = (list(corner) for corner in value)
            raise ValueError(f"the upper corner must lie above the lower {low}, got {high}")
        return value

    @model_validator(mode="after")
    def _one_resolution(self) -> MpmOptions:
        if self.particles is not None and self.grid_spacing is not None:
            raise ValueError("give either `particles` or `grid_spacing`, one of the two")
        return self

    def settings(self, grid_spacing: float) -> MpmSettings:
        """For the compiled model, whose cells are `grid_spacing` m."""
        own = ("kind", "particles", "particles_per_cell", "fill")
        kept = {k: v for k, v in self.model_dump().items() if k not in own}
        return MpmSettings(**{**kept, "grid_spacing": grid_spacing})


class CoupledOptions(Options):
    """Rigid bodies in MuJoCo that meet soft ones in FEM and MPM, two ways; each body may say its `solver`."""

    kind: Literal["coupled"] = "coupled"
    step: float = Field(
        default=Coupling.step, gt=0.0, le=0.05, description="s, at most, after which the solvers agree anew"
    )
    iterations: int = Field(
        default=Coupling.iterations, ge=1, le=100,
        description="at most, of a step until they agree; else it is halved",
    )  # fmt: skip
    tolerance: float = Field(
        default=Coupling.tolerance, gt=0.0,
        description="m/s, by which a rigid body may move otherwise than what it met was told",
    )  # fmt: skip
    fem: FemOptions = Field(default_factory=FemOptions, description="of the bodies in FEM")
    mpm: MpmOptions = Field(default_factory=MpmOptions, description="of the bodies in MPM")
    mujoco: MujocoOptions = Field(default_factory=MujocoOptions, description="of the rigid bodies")

    @model_validator(mode="after")
    def _in_time(self) -> CoupledOptions:
        if self.fem.integrator == "quasi-static":
            raise ValueError(
                "fem.integrator: quasi-static steps have no duration for bodies to push in; choose another"
            )
        return self


SolverOptions = Annotated[
    FemOptions | MpmOptions | MujocoOptions | CoupledOptions | AnimationOptions, Field(discriminator="kind")
]

__all__ = ["CoupledOptions", "FemOptions", "MpmOptions", "SolverOptions"]
