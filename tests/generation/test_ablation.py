"""Rows share their stages, end in what they say, and are judged against the reference."""

from __future__ import annotations

import pytest
import trimesh

from gdpro_sim.errors import RequestError
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.generation.ablation import ROWS, Case, Subject, cases, run_ablation
from gdpro_sim.generation.config import GenerationConfig, load_config
from gdpro_sim.generation.guidance.views import MeshGuidance
from gdpro_sim.generation.pipeline import Source
from gdpro_sim.generation.protocols import CoarseMesh, Stage, StepReport, UnitFrame
from gdpro_sim.meshing.surface import SurfaceMesh

TINY = load_config(
    "draft",
    overrides=[
        "surfels.iterations=4", "surfels.initial=1500", "surfels.maximum=1600", "surfels.resolution=32",
        "surfels.supersample=1", "surfels.batch=1", "surfels.initial_opacity=0.6", "surfels.densify_until=0",
        "refinement.iterations=3", "refinement.resolution=32", "refinement.supersample=1",
        "refinement.batch=1", "refinement.per_triangle=1", "extraction.cameras=8",
        "extraction.resolution=64", "extraction.depth=5", "extraction.triangles=400",
    ],
)  # fmt: skip


def ball(radius: float, color: tuple[float, float, float]) -> SurfaceMesh:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return SurfaceMesh.from_arrays(mesh.vertices, mesh.faces, color=color)


class Opened:
    """Opens a red ball that is to be made from a grey one, and counts how often anyone asks."""

    def __init__(self) -> None:
        self.subjects, self.priors = 0, 0
        self.jitters: list[float] = []

    def __call__(self, prompt: str, config: GenerationConfig, seed: int) -> Subject:
        self.subjects += 1
        self.jitters.append(config.guidance.jitter)
        truth = ball(0.9, (0.8, 0.2, 0.1))
        guidance = MeshGuidance(truth, config.guidance)

        def prior() -> CoarseMesh:
            self.priors += 1
            return CoarseMesh(ball(0.85, (0.5, 0.5, 0.5)))

        source = Source("ball", prompt, guidance, prior, UnitFrame((0.0, 0.0, 0.0), 1.0))
        return Subject(source, guidance.renderers[0], truth)


def test_every_row_ends_in_what_it_says() -> None:
    opened = Opened()
    steps: list[tuple[str, str]] = []

    def note(row: str, stage: Stage, report: StepReport) -> None:
        steps.append((row, stage.name))

    wanted = cases(["a ball"], [0], list(ROWS))
    outcomes = {
        o.case.row: o for o in run_ablation(wanted, TINY, opened, views=2, resolution=32, on_step=note)
    }
    assert tuple(outcomes) == ROWS
    assert opened.subjects == 1 and opened.priors == 1, "shared"
    assert steps.count(("surfels", "surfels")) == 4, "stage 1 runs once for all rows that start with it"
    assert steps.count(("gaussians", "surfels")) == 4 and steps.count(("no-prior", "surfels")) == 4
    for row in ("bound", "frozen", "unbound", "textured-mesh", "no-prior"):
        assert steps.count((row, "refinement")) == 3
    for row, outcome in outcomes.items():
        mesh = row in ("prior", "textured-mesh")
        assert isinstance(outcome.shown, SurfaceMesh if mesh else Gaussians)
        assert (outcome.gaussians == 0) == mesh
        assert (outcome.figures.chamfer is None) == (row == "unbound")
        assert (outcome.figures.strays is None) == mesh
        assert 5.0 < outcome.figures.psnr < 60.0
    prior = outcomes["prior"].figures
    assert prior.chamfer == pytest.approx(0.05, abs=0.005), "balls of radius 0.85 and 0.9"
    assert outcomes["frozen"].figures.chamfer == outcomes["textured-mesh"].figures.chamfer, "neither moves"
    assert outcomes["no-prior"].figures.chamfer != outcomes["bound"].figures.chamfer
    record = outcomes["bound"].to_json()
    assert record["prompt"] == "a ball" and record["row"] == "bound" and record["jitter"] == 0.0
    assert record["seconds_all"] >= record["seconds"] > 0.0


def test_figures_do_not_depend_on_which_other_rows_ran() -> None:
    rows = [["prior", "frozen"], ["frozen"]]
    both = [
        {o.case.row: o for o in run_ablation(cases(["a"], [1], r), TINY, Opened(), views=2, resolution=32)}
        for r in rows
    ]
    assert both[0]["frozen"].figures == both[1]["frozen"].figures


def test_the_sweep_gives_guidance_its_jitter() -> None:
    opened = Opened()
    wanted = cases(["a"], [0], ["prior"], [0.0, 0.2])
    outcomes = list(run_ablation(wanted, TINY, opened, views=2, resolution=32))
    assert opened.jitters == [0.0, 0.2]
    assert outcomes[0].figures == outcomes[1].figures, "the reference itself does not shake"


def test_cases_keep_a_fixed_order_and_refuse_nonsense() -> None:
    assert [c.row for c in cases(["a"], [0], ["bound", "prior"])] == ["prior", "bound"]
    assert len(cases(["a", "b"], [0, 1, 2], ["bound"], [0.0, 0.1])) == 12
    assert cases(["a"], [3], ["bound"]) == [Case("a", 3, 0.0, "bound")]
    with pytest.raises(RequestError, match="row 'floating' is not known; choose from prior, surfels"):
        cases(["a"], [0], ["floating"])
    with pytest.raises(RequestError, match="rows must name at least one"):
        cases(["a"], [0], [])
    with pytest.raises(RequestError, match="seeds are named twice: 1, 1"):
        cases(["a"], [1, 1], ["bound"])
    with pytest.raises(RequestError, match=r"jitter must be >= 0, got -0\.1"):
        cases(["a"], [1], ["bound"], [-0.1])
