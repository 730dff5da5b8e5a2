"""The paper's ablations: the same start taken through one variant of the method after the other, and judged.

A row is a variant. Rows of one prompt, seed and jitter share what comes before they part: the prior's mesh,
the Gaussians of stage 1 and the surface taken from them.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from gdpro_sim.errors import RequestError
from gdpro_sim.gaussians import Gaussians, Surfels
from gdpro_sim.generation.config import GenerationConfig
from gdpro_sim.generation.evaluation import Figures, Reference, evaluate
from gdpro_sim.generation.extraction import extract
from gdpro_sim.generation.pipeline import Source
from gdpro_sim.generation.priors.sphere import SpherePrior
from gdpro_sim.generation.protocols import Stage, StepReport, UnitFrame
from gdpro_sim.generation.refinement import RefinementStage
from gdpro_sim.generation.surfels import SurfelStage
from gdpro_sim.meshing.surface import SurfaceMesh

logger = logging.getLogger(__name__)

Row = Literal["prior", "surfels", "gaussians", "bound", "frozen", "unbound", "textured-mesh", "no-prior"]

ROWS: tuple[Row, ...] = get_args(Row)
"""prior: the coarse mesh alone; surfels, gaussians: stage 1 with 2D and 3D Gaussians, geometry that of the
surface taken from them; bound, frozen, unbound, textured-mesh: stage 2 so, after stage 1; no-prior: all of
it, bound, from a grey ball."""

Kind = Literal["surfels", "gaussians"]

Stepped = Callable[[str, Stage, StepReport], None]
"""Called with the row and what one iteration of its stage reported."""


@dataclass(frozen=True)
class Subject:
    """What a prompt and a seed stand for.

    reference: what the guidance draws, without jitter
    truth:     its mesh in the unit frame, or None where it has none: then there is no geometry to compare
    """

    source: Source
    reference: Reference
    truth: SurfaceMesh | None = None


OpenSubject = Callable[[str, GenerationConfig, int], Subject]
"""(prompt, configuration, seed) -> Subject."""


@dataclass(frozen=True)
class Case:
    """One cell of the experiment; jitter: of the guidance's target, in unit-frame lengths across a view."""

    prompt: str
    seed: int
    jitter: float
    row: Row


@dataclass(frozen=True)
class Outcome:
    """What came of a case.

    seconds:   wall time of the row's own stage, and of all it went through (shared parts count for each row)
    gaussians: how many Gaussians are shown, 0 for a mesh
    shown:     in the unit frame
    """

    case: Case
    figures: Figures
    gaussians: int
    iterations: int
    seconds: float
    seconds_all: float
    shown: Gaussians | SurfaceMesh

    def to_json(self) -> dict[str, Any]:
        """One flat record: the case, its figures, counts and times."""
        c = self.case
        return {
            "prompt": c.prompt,
            "seed": c.seed,
            "jitter": c.jitter,
            "row": c.row,
            **self.figures.to_json(),
            "gaussians": self.gaussians,
            "iterations": self.iterations,
            "seconds": round(self.seconds, 3),
            "seconds_all": round(self.seconds_all, 3),
        }


def cases(
    prompts: Sequence[str], seeds: Sequence[int], rows: Sequence[str], jitters: Sequence[float] = (0.0,)
) -> list[Case]:
    """Every combination, those that share stages next to each other.

    Raises RequestError for an unknown or repeated row, a negative jitter, or where there is nothing to do.
    """
    for row in rows:
        if row not in ROWS:
            raise RequestError(f"row {row!r} is not known; choose from {', '.join(ROWS)}")
    for name, values in (("rows", rows), ("prompts", prompts), ("seeds", seeds), ("jitters", jitters)):
        if not values:
            raise RequestError(f"{name} must name at least one")
        if len(set(values)) < len(values):
            raise RequestError(f"{name} are named twice: {', '.join(map(str, values))}")
    if min(jitters) < 0.0:
        raise RequestError(f"jitter must be >= 0, got {min(jitters)}")
    ordered = [row for row in ROWS if row in rows]
    return [Case(p, s, j, row) for p in prompts for s in seeds for j in jitters for row in ordered]


def run_ablation(
    wanted: Sequence[Case],
    config: GenerationConfig,
    open_subject: OpenSubject,
    *,
    views: int = 16,
    resolution: int = 192,
    on_step: Stepped | None = None,
) -> Iterator[Outcome]:
    """Outcomes of the wanted cases, one after the other; those in a row of the same start share its stages.

    views, resolution: of the held-out pictures that outcomes are judged by. The same arguments give the same
    figures on a CPU (not times). Raises GuidanceError, MeshError, RequestError.
    """
    start: Start | None = None
    for case in wanted:
        if start is None or start.key != (case.prompt, case.seed, case.jitter):
            guidance = config.guidance.model_copy(update={"jitter": case.jitter})
            settings = config.model_copy(update={"guidance": guidance})
            subject = open_subject(case.prompt, settings, case.seed)
            start = Start((case.prompt, case.seed, case.jitter), subject, settings, on_step)
        yield start.outcome(case, views, resolution)


@dataclass
class _Done:
    """A stage's result and how long it and all before it took, s."""

    result: Any
    seconds: float
    seconds_all: float
    iterations: int = 0


@dataclass
class Start:
    """One prompt, seed and jitter, and the stages that its rows share, each run when first asked for."""

    key: tuple[str, int, float]
    subject: Subject
    config: GenerationConfig
    on_step: Stepped | None = None
    _done: dict[str, _Done] = field(default_factory=dict)

    def outcome(self, case: Case, views: int, resolution: int) -> Outcome:
        """The row's variant, run and judged."""
        done, shown, surface = self._row(case.row)
        figures = evaluate(
            shown, self.subject.reference, surface=surface, truth=self.subject.truth,
            views=views, resolution=resolution, seed=case.seed,
        )  # fmt: skip
        count = len(shown) if isinstance(shown, Gaussians) else 0
        logger.info("%s, seed %d, jitter %g, %s: %.2f dB", *self.key, case.row, figures.psnr)
        return Outcome(case, figures, count, done.iterations, done.seconds, done.seconds_all, shown)

    def _row(self, row: Row) -> tuple[_Done, Gaussians | SurfaceMesh, SurfaceMesh | None]:
        """What the row ran, what to show of it, and its surface."""
        if row == "prior":
            prior = self._prior(row)
            return prior, prior.result, prior.result
        if row in ("surfels", "gaussians"):
            first = self._first(row, "surfels" if row == "surfels" else "gaussians")
            return first, plain(first.result), self._surface(row, first).result
        start = "no-prior" if row == "no-prior" else "surfels"
        first = self._first(start, "surfels")
        basic = self._surface(start, first)
        mode = "bound" if row == "no-prior" else row
        stage = RefinementStage(
            basic.result,
            self.subject.source.guidance,
            self.config.model_copy(
                update={"refinement": self.config.refinement.model_copy(update={"mode": mode})}
            ),
            self.key[1],
            start=first.result if mode == "unbound" else None,
        )
        second = self._run(row, stage, basic.seconds_all)
        if mode == "unbound":
            return second, stage.gaussians().to("cpu"), None
        mesh = stage.mesh()
        return second, mesh if mode == "textured-mesh" else stage.gaussians().to("cpu"), mesh

    def _prior(self, start: str) -> _Done:
        """The coarse mesh in the unit frame; a grey ball for "no-prior"."""
        name = "prior of no-prior" if start == "no-prior" else "prior"
        if name not in self._done:
            source, begin = self.subject.source, time.perf_counter()
            if source.prior is None:
                raise RequestError(f"{source.name}: an ablation starts from a prior, not from a splat cloud")
            frame = source.frame
            if start == "no-prior":
                frame = frame or UnitFrame.around(source.prior().surface.vertices)
                coarse = SpherePrior(frame).mesh(source.prompt, self.key[1])
            else:
                coarse = source.prior()
                frame = frame or UnitFrame.around(coarse.surface.vertices)
            took = time.perf_counter() - begin
            self._done[name] = _Done(frame.to_unit(coarse.surface), took, took)
        return self._done[name]

    def _first(self, start: str, kind: Kind) -> _Done:
        """Stage 1."""
        name = f"stage 1 of {start}"
        if name not in self._done:
            prior = self._prior(start)
            surfels = self.config.surfels.model_copy(update={"kind": kind})
            stage = SurfelStage(
                prior.result,
                self.subject.source.guidance,
                self.config.model_copy(update={"surfels": surfels}),
                self.key[1],
            )
            done = self._run(start, stage, prior.seconds_all)
            done.result = stage.result()
            self._done[name] = done
        return self._done[name]

    def _surface(self, start: str, first: _Done) -> _Done:
        """The mesh taken from stage 1."""
        name = f"surface of {start}"
        if name not in self._done:
            begin = time.perf_counter()
            mesh = extract(first.result, self.config.extraction)
            took = time.perf_counter() - begin
            self._done[name] = _Done(mesh, took, first.seconds_all + took)
        return self._done[name]

    def _run(self, row: str, stage: Stage, before: float) -> _Done:
        begin = time.perf_counter()
        while stage.iteration < stage.iterations:
            report = stage.step()
            if self.on_step is not None:
                self.on_step(row, stage, report)
        took = time.perf_counter() - begin
        return _Done(None, took, before + took, stage.iteration)


def plain(cloud: Gaussians | Surfels) -> Gaussians:
    """3D Gaussians on the CPU; surfels as thin ones."""
    return (cloud.gaussians() if isinstance(cloud, Surfels) else cloud).to("cpu")


__all__ = ["ROWS", "Case", "Outcome", "Row", "Subject", "cases", "plain", "run_ablation"]
