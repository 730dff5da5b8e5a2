"""Problems with known answers: `gdpro verify fem`, `gdpro verify mpm`, `mujoco` and `coupling`."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gdpro_sim.cli.common import AsJson, Debug, Quiet, app, progress, setup

if TYPE_CHECKING:
    from gdpro_sim.simulation.verification.framework import Check, Result

verify = typer.Typer(no_args_is_help=True, help="Run problems with known answers; exits with 1 on a failure.")
app.add_typer(verify, name="verify")

Only = Annotated[list[str] | None, typer.Option("--only", help="Name of a problem; repeat for several.")]
Listing = Annotated[bool, typer.Option("--list", help="Say which problems there are, and stop.")]
Quick = Annotated[bool, typer.Option("--quick", help="Leave out the slow problems.")]

QUANTITY_WIDTH = 68


ABOUT = {
    "fem": "Elements, materials, beams, vibrations, energy, contact, friction, robustness of FEM.",
    "mpm": "Materials, transfers, momenta, vibration, impact, fluids, sand, friction, equal bytes of MPM.",
    "coupling": "Momentum, rest, hinges, vibration, equal bytes of rigid bodies among soft ones.",
    "mujoco": "Inertia, friction, restitution, hinges, rest, flexes and exact states in MuJoCo.",
}


def _command(solver: str) -> Callable[..., None]:
    """The command of one solver, added."""

    @verify.command(solver, help=ABOUT[solver])
    def run(
        only: Only = None,
        listing: Listing = False,
        quick: Quick = False,
        json_output: AsJson = False,
        quiet: Quiet = False,
        debug: Debug = False,
    ) -> None:
        setup(quiet, debug)
        _verify(solver, only or [], listing, quick, json_output, quiet)

    return run


COMMANDS = {solver: _command(solver) for solver in ABOUT}


def _verify(solver: str, only: list[str], listing: bool, quick: bool, json_output: bool, quiet: bool) -> None:
    """Run the problems of one solver and print them as they end; exits with 1 where one failed."""
    from gdpro_sim.simulation.verification import problems
    from gdpro_sim.simulation.verification.framework import run_problem, select

    chosen = select(problems(solver), only, quick)
    if listing:
        _list(chosen, json_output)
        return
    results: list[Result] = []
    with progress(quiet or json_output) as report:
        for done, item in enumerate(chosen):
            report(item.name, done, len(chosen))
            result = run_problem(item)
            results.append(result)
            if not json_output and not (quiet and result.passed):
                print(_text(result), flush=True)
    failed = [result.problem.name for result in results if not result.passed]
    if json_output:
        print(json.dumps(_summary(solver, results)))
    elif not quiet:
        checks = sum(len(result.checks) for result in results)
        seconds = sum(result.seconds for result in results)
        end = f"failed: {', '.join(failed)}" if failed else "all pass"
        counted = "1 problem" if len(results) == 1 else f"{len(results)} problems"
        print(f"{counted}, {checks} checks, {seconds:.0f} s: {end}")
    if failed:
        raise typer.Exit(1)


def _list(chosen: list[Any], json_output: bool) -> None:
    if json_output:
        rows = [{"name": p.name, "title": p.title, "source": p.source, "slow": p.slow} for p in chosen]
        print(json.dumps(rows))
        return
    width = max(len(item.name) for item in chosen)
    for item in chosen:
        print(f"{item.name:<{width}}  {item.title}{' (slow)' if item.slow else ''}")


def _summary(solver: str, results: list[Result]) -> dict[str, Any]:
    return {
        "solver": solver,
        "passed": all(result.passed for result in results),
        "problems": {
            result.problem.name: {"passed": result.passed, "seconds": round(result.seconds, 3)}
            for result in results
        },
        "checks": [record for result in results for record in result.records()],
    }


def _text(result: Result) -> str:
    """A problem's title, source, and a line a check."""
    item = result.problem
    state = "pass" if result.passed else "FAIL"
    head = f"{'':<{QUANTITY_WIDTH}}{'expected':>14}{'measured':>14}{'error':>10}{'bound':>10}"
    lines = [
        f"{item.name}: {item.title}  [{state}, {result.seconds:.1f} s]",
        f"  from {item.source}",
        head,
        *(_line(check) for check in result.checks),
    ]
    if result.failure:
        lines.append(f"  {result.failure}")
    return "\n".join(lines) + "\n"


def _line(check: Check) -> str:
    quantity = f"  {check.quantity}" + (f", {check.unit}" if check.unit else "")
    state = "pass" if check.passed else "FAIL"
    if check.kind in ("at most", "at least"):
        sign = "<=" if check.kind == "at most" else ">="
        expected, error, bound = f"{sign} {check.expected:.6g}", "", ""
    else:
        expected, error = f"{check.expected:.6g}", f"{check.error:.1e}"
        bound = f"{check.bound:.2g}"
    return f"{quantity:<{QUANTITY_WIDTH}}{expected:>14}{check.measured:>14.6g}{error:>10}{bound:>10}  {state}"
