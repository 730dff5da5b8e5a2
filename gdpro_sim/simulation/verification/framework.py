"""Problems with known answers: what one is, running it, and its results as rows."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from gdpro_sim.errors import RequestError


@dataclass(frozen=True)
class Check:
    """One measured figure against what is known of it.

    quantity: what was measured, with the mesh where it matters
    bound:    largest error that passes: relative to |expected| (`kind` "relative"), in `unit` ("absolute");
              for one-sided checks ("at most", "at least") `expected` is the limit itself
    """

    quantity: str
    expected: float
    measured: float
    bound: float
    kind: Literal["relative", "absolute", "at most", "at least"]
    unit: str = ""

    @property
    def error(self) -> float:
        """Relative or absolute error; how far past the limit for one-sided checks (<= 0 passes)."""
        off = self.measured - self.expected
        if self.kind == "relative":
            return abs(off) / abs(self.expected)
        if self.kind == "absolute":
            return abs(off)
        return off if self.kind == "at most" else -off

    @property
    def passed(self) -> bool:
        return math.isfinite(self.measured) and self.error <= self.bound


def relative(quantity: str, expected: float, measured: float, bound: float, unit: str = "") -> Check:
    """`measured` lies within `bound` * |expected| of `expected`."""
    return Check(quantity, float(expected), float(measured), bound, "relative", unit)


def absolute(quantity: str, expected: float, measured: float, bound: float, unit: str = "") -> Check:
    """`measured` lies within `bound` of `expected`."""
    return Check(quantity, float(expected), float(measured), bound, "absolute", unit)


def at_most(quantity: str, limit: float, measured: float, unit: str = "") -> Check:
    return Check(quantity, float(limit), float(measured), 0.0, "at most", unit)


def at_least(quantity: str, limit: float, measured: float, unit: str = "") -> Check:
    return Check(quantity, float(limit), float(measured), 0.0, "at least", unit)


@dataclass(frozen=True)
class Problem:
    """A question with a known answer.

    name:   what `--only` takes, unique within its solver
    title:  one line
    source: where the expected values come from
    run:    does the work, one `Check` after another
    slow:   left out of the quick set
    """

    name: str
    title: str
    source: str
    run: Callable[[], Iterable[Check]]
    slow: bool = False


def problem(
    name: str, *, title: str, source: str, slow: bool = False
) -> Callable[[Callable[[], Iterable[Check]]], Problem]:
    """Make a `Problem` of a function that yields its checks."""

    def make(run: Callable[[], Iterable[Check]]) -> Problem:
        return Problem(name, title, source, run, slow)

    return make


@dataclass(frozen=True)
class Result:
    """A problem that was run.

    failure: one line where the problem ended in an error; its checks so far are kept
    """

    problem: Problem
    checks: tuple[Check, ...]
    seconds: float
    failure: str = ""

    @property
    def passed(self) -> bool:
        return not self.failure and bool(self.checks) and all(check.passed for check in self.checks)

    def records(self) -> list[dict[str, Any]]:
        """One flat dictionary a check, for JSON; figures that are not finite become None."""
        shared = {"problem": self.problem.name, "title": self.problem.title, "source": self.problem.source}
        found: list[dict[str, Any]] = []
        for check in self.checks:
            figures = {
                "expected": check.expected,
                "measured": check.measured,
                "error": check.error,
                "bound": check.bound,
            }
            found.append(
                {
                    **shared,
                    "quantity": check.quantity,
                    "unit": check.unit,
                    "kind": check.kind,
                    **{key: value if math.isfinite(value) else None for key, value in figures.items()},
                    "passed": check.passed,
                }
            )
        if self.failure:
            found.append({**shared, "failure": self.failure, "passed": False})
        return found


def run_problem(item: Problem) -> Result:
    """Run one problem; an error is a failed result, so that the other problems are still run."""
    begin, checks, failure = time.perf_counter(), [], ""
    try:
        for check in item.run():
            checks.append(check)
    except Exception as error:
        failure = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
    return Result(item, tuple(checks), time.perf_counter() - begin, failure)


def select(items: Sequence[Problem], only: Sequence[str] = (), quick: bool = False) -> list[Problem]:
    """The problems named in `only` (all of them without), without the slow ones for the quick set.

    Raises RequestError for a name that no problem has. A slow problem that is named is kept.
    """
    names = {item.name for item in items}
    for name in only:
        if name not in names:
            raise RequestError(f"no problem is called {name!r}; there are: {', '.join(sorted(names))}")
    if only:
        return [item for item in items if item.name in only]
    return [item for item in items if not (quick and item.slow)]


__all__ = [
    "Check",
    "Problem",
    "Result",
    "absolute",
    "at_least",
    "at_most",
    "problem",
    "relative",
    "run_problem",
    "select",
]
