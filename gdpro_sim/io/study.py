"""A blinded study as a static page, and the count of its answers.

`write_study` makes `page/` (index.html and its pictures; put it on any web server or open the file) and
`key.json` (which picture is whose), which stays with whoever runs the study. The page names no method, needs
no network and works from the keyboard; people's answers are saved by their browser as a JSON file each.
`tally` maps those files back through the key. No number comes from anywhere but such files.
"""

from __future__ import annotations

import hashlib
import html
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim.errors import RequestError
from gdpro_sim.files import atomic_write, prepare_folder
from gdpro_sim.io.images import read_png, write_png

STAGES = ("refinement", "extraction", "surfels", "prior")
"""Turntables of a run folder; the first that is there is shown."""

PICTURES, VIDEOS = (".png",), (".mp4", ".webm")

FORMAT = 1


@dataclass(frozen=True)
class Study:
    """Where the page and its key lie, and how many questions it asks."""

    page: Path
    key: Path
    questions: int


@dataclass(frozen=True)
class Count:
    """How often one method was preferred.

    share: of the answers that preferred any; low, high: its 95 % Clopper-Pearson interval
    """

    method: str
    preferred: int
    share: float
    low: float
    high: float


@dataclass(frozen=True)
class Tally:
    """people: answer files; decided, undecided: answers that preferred one, and that could not say."""

    people: int
    decided: int
    undecided: int
    counts: tuple[Count, ...]

    def text(self) -> str:
        """A few plain lines."""
        lines = [f"{self.people} people, {self.decided} preferences, {self.undecided} times none"]
        width = max(len(c.method) for c in self.counts)
        for c in self.counts:
            lines.append(
                f"{c.method:<{width}}  {c.preferred:>4}  {100 * c.share:5.1f} %"
                f"  (95 %: {100 * c.low:.1f} to {100 * c.high:.1f} %)"
            )
        lines.append(
            "Exact binomial intervals; they take answers as independent, which several by one person are not."
        )
        return "\n".join(lines)


def write_study(folders: Sequence[str | Path], output: str | Path, seed: int) -> Study:
    """Write the page and its key for two or more folders of results.

    A folder holds one entry per prompt: a run folder of `gdpro generate --run` (its last turntable is shown
    and its prompt asked about), or a picture or video whose name is the prompt. Prompts that are in every
    folder are asked about. Which side a method is on and the order of the questions are drawn from `seed`.
    Pictures are written anew under neutral names, so that neither name nor metadata tells; videos are copied.
    Raises RequestError for fewer than two folders, none in common, or a used output; OutputError.
    """
    if len(folders) < 2:
        raise RequestError(f"a study compares at least two folders, got {len(folders)}")
    names = _method_names(folders)
    found = [_entries(Path(folder)) for folder in folders]
    prompts = sorted(set.intersection(*(set(entries) for entries in found)))
    if not prompts:
        counts = ", ".join(f"{f}: {len(e)}" for f, e in zip(folders, found, strict=True))
        raise RequestError(f"the folders have no prompt in common ({counts}); entries match by prompt")
    root = prepare_folder(output, "key.json")
    if any(root.iterdir()):
        raise RequestError(f"{output} is not empty; give a new folder, or answers could not be told apart")
    media = prepare_folder(root / "page" / "media", "x.png")
    generator = np.random.default_rng(seed)
    questions, key = [], {}
    for number, prompt in enumerate(generator.permutation(np.array(prompts, dtype=object))):
        choices = []
        for method in generator.permutation(len(folders)):
            name = generator.bytes(6).hex()
            file = _publish(found[method][prompt], media / name)
            choices.append({"id": name, "file": f"media/{file.name}"})
            key[name] = names[method]
        questions.append({"id": f"q{number + 1}", "prompt": prompt, "choices": choices})
    secret = {
        "format": FORMAT,
        "seed": seed,
        "nonce": generator.bytes(16).hex(),
        "methods": list(names),
        "questions": {q["id"]: {"prompt": q["prompt"], "choices": [c["id"] for c in q["choices"]]}
                      for q in questions},
        "key": key,
    }  # fmt: skip
    with atomic_write(root / "key.json") as temporary:
        temporary.write_text(json.dumps(secret, indent=1), encoding="utf-8")
    page = root / "page" / "index.html"
    with atomic_write(page) as temporary:
        temporary.write_text(_page(questions, _seal(secret)), encoding="utf-8")
    return Study(page, root / "key.json", len(questions))


def tally(key: str | Path, answers: Sequence[str | Path]) -> Tally:
    """Count the answers in people's JSON files by method.

    Raises RequestError where there is no file, one is not of this study, answers a question twice or with
    what was not offered, or is there twice.
    """
    from scipy.stats import binomtest

    secret = _read(Path(key))
    if secret.get("format") != FORMAT or not {"key", "questions", "methods"} <= set(secret):
        raise RequestError(f"{key} is not the key of a study (key.json beside its page)")
    if not answers:
        raise RequestError("no answers to count: give the JSON files that people saved")
    seal, seen = _seal(secret), set()
    preferred = dict.fromkeys(secret["methods"], 0)
    undecided = 0
    for path in map(Path, answers):
        data = _read(path)
        if data.get("study") != seal:
            raise RequestError(f"{path} answers another study than {key}")
        whose = json.dumps(data, sort_keys=True)
        if whose in seen:
            raise RequestError(f"{path} is the same as another file; count it once")
        seen.add(whose)
        for question, choice in _answers(data, path).items():
            if question not in secret["questions"]:
                raise RequestError(f"{path}: question {question!r} was not asked")
            if choice is None:
                undecided += 1
            elif choice in secret["questions"][question]["choices"]:
                preferred[secret["key"][choice]] += 1
            else:
                raise RequestError(f"{path}: {choice!r} is no choice of question {question}")
    decided = sum(preferred.values())
    counts = []
    for method, wins in preferred.items():
        low, high = 0.0, 1.0
        if decided:
            interval = binomtest(wins, decided).proportion_ci(0.95, method="exact")
            low, high = float(interval.low), float(interval.high)
        counts.append(Count(method, wins, wins / decided if decided else 0.0, low, high))
    return Tally(len(seen), decided, undecided, tuple(counts))


def _answers(data: dict[str, Any], path: Path) -> dict[str, str | None]:
    """Choice by question; None where someone could not say."""
    out: dict[str, str | None] = {}
    rows = data.get("answers")
    if not isinstance(rows, list):
        raise RequestError(f"{path} holds no answers")
    for row in rows:
        if not isinstance(row, dict) or not isinstance(row.get("question"), str):
            raise RequestError(f"{path}: an answer names no question: {row!r}")
        if row["question"] in out:
            raise RequestError(f"{path} answers question {row['question']} twice")
        choice = row.get("choice")
        if choice is not None and not isinstance(choice, str):
            raise RequestError(f"{path}: choice of question {row['question']} is {choice!r}")
        out[row["question"]] = choice
    return out


def _read(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RequestError(f"{path}: cannot be read ({error})") from None
    if not isinstance(data, dict):
        raise RequestError(f"{path} does not hold a JSON object")
    return data


def _seal(secret: dict[str, Any]) -> str:
    """What the page says of the key: its hash, so that a key changed afterwards no longer fits."""
    return hashlib.sha256(json.dumps(secret, sort_keys=True).encode()).hexdigest()


def _method_names(folders: Sequence[str | Path]) -> list[str]:
    """Folder names, or whole paths where two are alike."""
    names = [Path(folder).resolve().name for folder in folders]
    if len(set(names)) < len(names):
        names = [str(Path(folder).resolve()) for folder in folders]
    if len(set(names)) < len(names):
        raise RequestError(f"a folder is named twice: {', '.join(map(str, folders))}")
    return names


def _entries(folder: Path) -> dict[str, Path]:
    """Prompt -> picture or video in a folder of results."""
    if not folder.is_dir():
        raise RequestError(f"{folder} is not a folder")
    out: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.is_dir() and (path / "run.json").is_file():
            inputs = _read(path / "run.json").get("inputs", {})
            prompt = str(inputs.get("prompt") or path.name)
            shown = next((path / f"{s}.png" for s in STAGES if (path / f"{s}.png").is_file()), None)
        elif path.suffix.lower() in (*PICTURES, *VIDEOS):
            prompt, shown = path.stem.replace("_", " "), path
        else:
            continue
        if shown is None:
            raise RequestError(f"{path} has no turntable yet; finish that run, or take it out of {folder}")
        if prompt in out:
            raise RequestError(f"{folder} has two results for {prompt!r}: {out[prompt].name} and {path.name}")
        out[prompt] = shown
    if not out:
        raise RequestError(f"{folder} holds neither run folders nor pictures or videos named after prompts")
    return out


def _publish(source: Path, target: Path) -> Path:
    """A copy of a picture or video under a neutral name; pictures lose their metadata and time."""
    path = target.with_suffix(source.suffix.lower())
    if path.suffix in PICTURES:
        write_png(path, read_png(source))
    else:
        with atomic_write(path) as temporary:
            shutil.copyfile(source, temporary)
    return path


def _page(questions: list[dict[str, Any]], seal: str) -> str:
    body = "\n".join(_question(q, n, len(questions)) for n, q in enumerate(questions, 1))
    return _PAGE.replace("@QUESTIONS@", body).replace("@SEAL@", seal).replace("@COUNT@", str(len(questions)))


def _question(question: dict[str, Any], number: int, count: int) -> str:
    prompt, name = html.escape(question["prompt"]), question["id"]
    cells = []
    for place, choice in enumerate(question["choices"], 1):
        file, label = choice["file"], f"Picture {place}"
        if Path(file).suffix in VIDEOS:
            shown = f'<video src="{file}" controls loop muted playsinline aria-label="{label}"></video>'
        else:
            shown = f'<img src="{file}" alt="{label}: an object seen from several sides">'
        cells.append(
            f'<label class="choice"><input type="radio" name="{name}" value="{choice["id"]}"> {label}'
            f"{shown}</label>"
        )
    return (
        f'<fieldset><legend>{number} of {count}: <q>{prompt}</q></legend>\n<div class="row">\n'
        + "\n".join(cells)
        + f'\n</div>\n<label class="none"><input type="radio" name="{name}" value=""> I cannot say</label>\n'
        "</fieldset>"
    )


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Which do you prefer?</title>
<style>
body { font: 1.05rem/1.5 system-ui, sans-serif; max-width: 72rem; margin: 0 auto; padding: 1rem;
  color: #1c1f24; background: #fff; }
fieldset { border: 1px solid #767b84; border-radius: 6px; margin: 1.5rem 0; padding: 1rem; }
legend { font-weight: 600; padding: 0 .4rem; }
.row { display: grid; grid-template-columns: repeat(auto-fit, minmax(16rem, 1fr)); gap: 1rem; }
.choice { display: block; padding: .5rem; border: 2px solid transparent; border-radius: 6px; }
.choice:has(:checked) { border-color: #0b57d0; background: #eef3fd; }
:focus-visible { outline: 3px solid #0b57d0; outline-offset: 2px; }
img, video { display: block; width: 100%; height: auto; margin-top: .4rem; }
input[type=radio] { width: 1.2rem; height: 1.2rem; vertical-align: middle; }
.none { display: inline-block; padding: .5rem; }
button, input[type=text] { font: inherit; padding: .5rem .9rem; }
</style>
</head>
<body>
<main>
<h1>Which do you prefer?</h1>
<p>Each question shows the same description made in different ways. Choose the picture that you find better:
how well it fits the description and how good it looks. Take your time; there is no right answer. Tab moves
to the next question, the arrow keys choose. Nothing is sent anywhere: at the end you save your answers as a
file and give it to whoever asked you.</p>
<noscript><p><strong>This page needs JavaScript to save your answers.</strong></p></noscript>
<form id="study">
@QUESTIONS@
<p><label>A name or number for you, if you were given one:
<input type="text" id="participant" autocomplete="off"></label></p>
<p><button type="submit">Save my answers</button></p>
<p id="status" role="status" aria-live="polite"></p>
</form>
</main>
<script>
"use strict";
const seal = "@SEAL@", count = @COUNT@;
const form = document.getElementById("study"), status = document.getElementById("status");
function answers() {
  const out = [];
  for (const [question, choice] of new FormData(form)) {
    out.push({ question: question, choice: choice === "" ? null : choice });
  }
  return out;
}
function keep() {
  try { localStorage.setItem(seal, JSON.stringify(answers())); } catch (error) { /* private window */ }
  status.textContent = answers().length + " of " + count + " answered";
}
try {
  for (const row of JSON.parse(localStorage.getItem(seal) || "[]")) {
    for (const input of form.querySelectorAll("input[type=radio]")) {
      if (input.name === row.question && input.value === (row.choice || "")) input.checked = true;
    }
  }
} catch (error) { /* private window */ }
form.addEventListener("change", keep);
form.addEventListener("submit", function (event) {
  event.preventDefault();
  const given = answers();
  if (given.length < count) {
    status.textContent = given.length + " of " + count + " answered; please answer the rest";
    for (const set of form.querySelectorAll("fieldset")) {
      if (!set.querySelector(":checked")) { set.querySelector("input").focus(); break; }
    }
    return;
  }
  const data = { study: seal, participant: document.getElementById("participant").value,
    saved: new Date().toISOString(), answers: given };
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([JSON.stringify(data, null, 1)], { type: "application/json" }));
  link.download = "answers-" + Date.now() + ".json";
  link.click();
  URL.revokeObjectURL(link.href);
  status.textContent = "Saved. Thank you!";
});
keep();
</script>
</body>
</html>
"""

__all__ = ["Count", "Study", "Tally", "tally", "write_study"]
