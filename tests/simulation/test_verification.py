"""Problems with known answers, and the command that runs them."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
import typer

from gdpro_sim.cli.verify import COMMANDS
from gdpro_sim.errors import RequestError, SolverError
from gdpro_sim.simulation.verification import SOLVERS, problems
from gdpro_sim.simulation.verification import fem as suite
from gdpro_sim.simulation.verification.beams import Beam
from gdpro_sim.simulation.verification.framework import (
    Check,
    Problem,
    absolute,
    at_least,
    at_most,
    problem,
    relative,
    run_problem,
    select,
)
from gdpro_sim.simulation.verification.models import tet_ball, uneven_box
from gdpro_sim.simulation.verification.reference import ReferenceFem

ALL = [(solver, item) for solver in SOLVERS for item in problems(solver)]


@pytest.mark.parametrize(
    "item",
    [
        pytest.param(p, id=f"{solver}-{p.name}", marks=[pytest.mark.slow] if p.slow else [])
        for solver, p in ALL
    ],
)
def test_known_answers(item: Problem) -> None:
    result = run_problem(item)
    assert not result.failure
    assert [f"{c.quantity}: {c.measured!r}, not {c.expected!r}" for c in result.checks if not c.passed] == []
    assert result.passed


def test_names_are_unique_and_sources_given() -> None:
    for solver in SOLVERS:
        names = [item.name for item in problems(solver)]
        assert len(set(names)) == len(names)
    assert all(item.title and item.source for _, item in ALL)


@pytest.mark.parametrize(
    ("check", "passed"),
    [
        (relative("", 2.0, 2.1, 0.06), True),
        (relative("", -2.0, -2.1, 0.04), False),
        (absolute("", 0.0, 1e-3, 1e-2), True),
        (absolute("", 0.0, -1e-1, 1e-2), False),
        (at_most("", 1.0, 1.0), True),
        (at_most("", 1.0, 1.1), False),
        (at_least("", 1.0, 1.0), True),
        (at_least("", 1.0, 0.9), False),
        (relative("", 1.0, math.nan, 1.0), False),
        (at_most("", 1.0, -math.inf), False),
    ],
)
def test_checks_judge(check: Check, passed: bool) -> None:
    assert check.passed is passed


def test_an_error_is_a_failed_result_with_the_checks_before_it() -> None:
    @problem("breaks", title="It breaks", source="here")
    def breaks() -> Iterator[Check]:
        yield at_most("fine", 1.0, 0.0)
        raise SolverError("no solution\nat all")

    result = run_problem(breaks)
    assert not result.passed and len(result.checks) == 1
    assert result.failure == "SolverError: no solution"
    assert result.records()[-1]["failure"] == result.failure
    assert json.dumps(result.records())


def test_a_problem_without_checks_does_not_pass() -> None:
    assert not run_problem(Problem("empty", "", "", lambda: ())).passed


def test_selection() -> None:
    items = [Problem("a", "", "", lambda: ()), Problem("b", "", "", lambda: (), slow=True)]
    assert [p.name for p in select(items)] == ["a", "b"]
    assert [p.name for p in select(items, quick=True)] == ["a"]
    assert [p.name for p in select(items, ["b"], quick=True)] == ["b"]
    with pytest.raises(RequestError, match="'c'; there are: a, b"):
        select(items, ["c"])


def test_beam_theory() -> None:
    """Against the figures of textbooks: slender beams lose their shear, the elastica its curvature."""
    beam = Beam(length=1.0, side=0.2, young=1e7, poisson=0.3, density=1000.0)
    assert beam.sag() == pytest.approx(0.03829, rel=1e-4)
    assert beam.tip_deflection(100.0, 1.0) == pytest.approx(0.02576, rel=2e-4)
    slender = Beam(length=1.0, side=0.01, young=1e9, poisson=0.3, density=1000.0)
    euler = [1.8751, 4.6941, 7.8548]
    unit = math.sqrt(slender.bending / (slender.density * slender.side**2)) / (2 * math.pi)
    assert slender.frequencies(3) == pytest.approx([unit * b * b for b in euler], rel=5e-3)
    # Bisshopp & Drucker 1945: P L^2 / EI = 1 gives a drop of 0.3017 L and a reach of 0.9436 L.
    reach, drop = slender.elastica(slender.bending, heavy=False)
    assert (reach, drop) == pytest.approx((0.9436, 0.3017), abs=2e-4)
    stiff = Beam(length=1.0, side=0.05, young=1e9, poisson=0.3, density=1000.0)
    assert stiff.elastica()[1] == pytest.approx(stiff.sag(), rel=3e-3)


def test_the_command_prints_figures_and_passes() -> None:
    command = [
        sys.executable,
        "-m",
        "gdpro_sim.cli",
        "verify",
        "fem",
        "--only",
        "uniaxial",
        "--only",
        "shear",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    for word in ("uniaxial", "Smith et al. 2018", "expected", "P11 / E at 0.7", "-0.381139", "all pass"):
        assert word in done.stdout, word


def test_the_command_lists_and_speaks_json(capsys: pytest.CaptureFixture[str]) -> None:
    COMMANDS["fem"](listing=True)
    listed = capsys.readouterr().out
    assert "elastica" in listed and "long-run" in listed
    COMMANDS["fem"](listing=True, quick=True)
    assert "long-run" not in capsys.readouterr().out
    COMMANDS["fem"](only=["patch"], json_output=True)
    summary = json.loads(capsys.readouterr().out)
    assert summary["passed"] and list(summary["problems"]) == ["patch"]
    assert {"quantity", "expected", "measured", "error", "bound", "passed"} <= set(summary["checks"][0])


def test_the_command_takes_mpm(capsys: pytest.CaptureFixture[str]) -> None:
    COMMANDS["mpm"](listing=True)
    listed = capsys.readouterr().out
    assert "dam-break" in listed and "(slow)" in listed
    COMMANDS["mpm"](only=["fluid"])
    assert "Monaghan 1994" in capsys.readouterr().out


def test_the_command_fails_where_a_problem_fails(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = Problem("wrong", "One is two", "nowhere", lambda: [relative("one", 2.0, 1.0, 0.1)])
    monkeypatch.setattr(suite, "PROBLEMS", (wrong,))
    with pytest.raises(typer.Exit) as left:
        COMMANDS["fem"](quiet=True)
    assert left.value.exit_code == 1
    printed = capsys.readouterr().out
    assert "FAIL" in printed and "One is two" in printed


def test_an_unknown_problem_is_refused() -> None:
    with pytest.raises(RequestError, match="no problem is called 'nonsense'"):
        COMMANDS["fem"](only=["nonsense"])


def test_the_reference_agrees_with_its_own_derivatives() -> None:
    """Gradient and Hessian of the oracle against finite differences of its energy and gradient."""
    vertices, tets, _ = uneven_box(2, 0.4)
    oracle = ReferenceFem(vertices, tets, 1e5, 0.3, 1000.0, np.zeros(len(vertices), bool))
    rng = np.random.default_rng(0)
    x = vertices + 0.01 * rng.normal(size=vertices.shape)
    d = rng.normal(size=vertices.shape)
    step = 1e-6
    slope = (oracle.elastic_energy(x + step * d) - oracle.elastic_energy(x - step * d)) / (2 * step)
    assert slope == pytest.approx(float((oracle.elastic_gradient(x) * d).sum()), rel=1e-6)
    change = (oracle.elastic_gradient(x + step * d) - oracle.elastic_gradient(x - step * d)) / (2 * step)
    product = oracle.elastic_hessian(x, projected=False) @ d.reshape(-1)
    assert np.abs(change.reshape(-1) - product).max() <= 1e-6 * np.abs(product).max()


def test_the_ball_is_a_ball() -> None:
    for cells, grading in ((6, 0.0), (10, 2.5)):
        vertices, tets = tet_ball(cells, 2.0, grading)
        corners = vertices[tets]
        volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
        assert volumes.min() > 0.0
        assert volumes.sum() == pytest.approx(4.0 / 3.0 * np.pi * 8.0, rel=0.1)
        assert np.linalg.norm(vertices, axis=1).max() == pytest.approx(2.0)
