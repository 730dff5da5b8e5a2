"""A page that tells nothing, and a count that trusts nobody."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from gdpro_sim.errors import RequestError
from gdpro_sim.io.images import read_png
from gdpro_sim.io.study import Study, tally, write_study

PROMPTS = ["a red mug", "a <b>bold</b> & blue chair", "a duck", "a lamp", "a boat"]


def runs(folder: Path, shade: int, prompts: list[str] = PROMPTS) -> Path:
    """Run folders with one-colour turntables whose metadata tells whose they are."""
    for number, prompt in enumerate(prompts):
        run = folder / f"run{number}"
        run.mkdir(parents=True)
        (run / "run.json").write_text(json.dumps({"inputs": {"prompt": prompt}}))
        told = PngImagePlugin.PngInfo()
        told.add_text("method", folder.name)
        picture = Image.fromarray(np.full((8, 12, 3), shade + number, np.uint8))
        picture.save(run / "refinement.png", pnginfo=told)
        Image.fromarray(np.zeros((8, 12, 3), np.uint8)).save(run / "prior.png")
    return folder


def made(tmp_path: Path, seed: int = 0, output: str = "study") -> Study:
    if not (tmp_path / "ours").exists():
        runs(tmp_path / "ours", 10)
        runs(tmp_path / "theirs", 100, [*PROMPTS[::-1], "only theirs"])
    return write_study([tmp_path / "ours", tmp_path / "theirs"], tmp_path / output, seed)


class Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


def test_the_page_asks_about_what_all_have_and_tells_nothing(tmp_path: Path) -> None:
    study = made(tmp_path)
    assert study.questions == len(PROMPTS)
    source = study.page.read_text()
    page = Page(source)
    assert len(page.all("fieldset")) == 5 and len(page.all("img")) == 10
    assert "ours" not in source and "theirs" not in source and "refinement" not in source
    assert not re.search(r"https?://|//cdn", source), "no network"
    assert "a <b>bold</b> & blue chair" in page.text and not page.all("b"), "prompts are text"
    assert all(image["alt"] for image in page.all("img")) and page.all("html")[0]["lang"] == "en"
    radios = [i for i in page.all("input") if i.get("type") == "radio"]
    assert len(radios) == 15 and len(page.all("legend")) == 5, "a way out of every question"
    for image in page.all("img"):
        file = study.page.parent / str(image["src"])
        with Image.open(file) as opened:
            assert not opened.info.get("method")
    assert not (study.page.parent / "key.json").exists(), "the key does not travel with the page"


def test_the_key_says_whose_each_picture_is(tmp_path: Path) -> None:
    study = made(tmp_path)
    secret = json.loads(study.key.read_text())
    for question in secret["questions"].values():
        shades = {}
        for choice in question["choices"]:
            shades[secret["key"][choice]] = int(
                read_png(study.page.parent / "media" / f"{choice}.png")[0, 0, 0]
            )
        number = PROMPTS.index(question["prompt"])
        assert shades == {"ours": 10 + number, "theirs": 100 + len(PROMPTS) - 1 - number}


def test_sides_and_order_are_drawn_from_the_seed(tmp_path: Path) -> None:
    def sides(seed: int, output: str) -> list[tuple[str, str]]:
        study = made(tmp_path, seed, output)
        secret = json.loads(study.key.read_text())
        return [(q["prompt"], secret["key"][q["choices"][0]]) for q in secret["questions"].values()]

    first = sides(0, "a")
    assert sides(0, "b") == first
    assert (tmp_path / "a/page/index.html").read_bytes() == (tmp_path / "b/page/index.html").read_bytes()
    drawn = [sides(seed, f"s{seed}") for seed in range(1, 12)]
    assert len({tuple(p for p, _ in d) for d in drawn}) > 5, "order"
    assert {side for d in drawn for _, side in d} == {"ours", "theirs"}
    left = sum(side == "ours" for d in drawn for _, side in d)
    assert 12 < left < 43, "of 55, neither side is one method's"


def answer(study: Study, path: Path, prefer: str | None, wins: int, name: str = "") -> Path:
    """Someone who prefers `prefer` in the first `wins` questions and the other one after."""
    secret = json.loads(study.key.read_text())
    seal = re.search(r'seal = "([0-9a-f]{64})"', study.page.read_text())
    assert seal is not None
    rows: list[dict[str, str | None]] = []
    for index, (question, entry) in enumerate(secret["questions"].items()):
        mine = [c for c in entry["choices"] if (secret["key"][c] == prefer) == (index < wins)]
        rows.append({"question": question, "choice": mine[0] if prefer else None})
    path.write_text(json.dumps({"study": seal[1], "participant": name, "answers": rows}))
    return path


def test_answers_are_counted_with_exact_intervals(tmp_path: Path) -> None:
    study = made(tmp_path)
    files = [
        answer(study, tmp_path / "1.json", "ours", 5, "one"),
        answer(study, tmp_path / "2.json", "ours", 3, "two"),
        answer(study, tmp_path / "3.json", None, 0),
    ]
    result = tally(study.key, files)
    assert (result.people, result.decided, result.undecided) == (3, 10, 5)
    ours, theirs = result.counts
    assert (ours.method, ours.preferred, theirs.preferred) == ("ours", 8, 2)
    # Clopper and Pearson (1934) for 8 of 10.
    assert (ours.low, ours.high) == pytest.approx((0.4439, 0.9748), abs=1e-4)
    assert (theirs.low, theirs.high) == pytest.approx((1 - 0.9748, 1 - 0.4439), abs=1e-4)
    assert "ours       8   80.0 %  (95 %: 44.4 to 97.5 %)" in result.text()
    nobody = tally(study.key, files[2:])
    assert nobody.decided == 0 and (nobody.counts[0].low, nobody.counts[0].high) == (0.0, 1.0)


def test_what_does_not_fit_is_not_counted(tmp_path: Path) -> None:
    study = made(tmp_path)
    good = answer(study, tmp_path / "good.json", "ours", 5)
    data = json.loads(good.read_text())

    def refused(change: dict[str, object], message: str) -> None:
        bad = tmp_path / "bad.json"
        bad.write_text(json.dumps({**data, **change}))
        with pytest.raises(RequestError, match=message):
            tally(study.key, [bad])

    refused({"study": "0" * 64}, "answers another study")
    refused({"answers": data["answers"] + data["answers"][:1]}, "twice")
    refused({"answers": [{"question": "q99", "choice": None}]}, "was not asked")
    refused({"answers": [{"question": "q1", "choice": "feed"}]}, "is no choice of question q1")
    refused({"answers": None}, "holds no answers")
    refused({"answers": [7]}, "names no question")
    (tmp_path / "copy.json").write_text(good.read_text())
    with pytest.raises(RequestError, match="same as another file"):
        tally(study.key, [good, tmp_path / "copy.json"])
    with pytest.raises(RequestError, match="no answers to count"):
        tally(study.key, [])
    with pytest.raises(RequestError, match="is not the key of a study"):
        tally(good, [good])
    secret = json.loads(study.key.read_text())
    first, second = list(secret["key"])[:2]
    secret["key"][first], secret["key"][second] = secret["key"][second], secret["key"][first]
    study.key.write_text(json.dumps(secret))
    with pytest.raises(RequestError, match="another study"):
        tally(study.key, [good])


def test_pictures_and_videos_named_after_prompts_will_do(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / name / "a_duck.png")
        (tmp_path / name / "a_cat.mp4").write_bytes(name.encode())
        (tmp_path / name / "notes.txt").write_text("not shown")
    study = write_study([tmp_path / "a", tmp_path / "b"], tmp_path / "out", 0)
    page = Page(study.page.read_text())
    assert study.questions == 2 and len(page.all("video")) == 2 and len(page.all("img")) == 2
    assert all("controls" in video for video in page.all("video")), "reachable from the keyboard"


def test_wrong_folders_are_named(tmp_path: Path) -> None:
    ours = runs(tmp_path / "ours", 10, ["a duck"])
    other = runs(tmp_path / "other", 10, ["a boat"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(RequestError, match="at least two folders, got 1"):
        write_study([ours], tmp_path / "out", 0)
    with pytest.raises(RequestError, match="no prompt in common"):
        write_study([ours, other], tmp_path / "out", 0)
    with pytest.raises(RequestError, match="named twice"):
        write_study([ours, ours], tmp_path / "out", 0)
    with pytest.raises(RequestError, match="is not a folder"):
        write_study([ours, tmp_path / "none"], tmp_path / "out", 0)
    with pytest.raises(RequestError, match="holds neither run folders"):
        write_study([ours, tmp_path / "empty"], tmp_path / "out", 0)
    same = runs(tmp_path / "same", 10, ["a duck"])
    (tmp_path / "out").mkdir(exist_ok=True)
    (tmp_path / "out" / "x").write_text("")
    with pytest.raises(RequestError, match="is not empty"):
        write_study([ours, same], tmp_path / "out", 0)
    for stage in ("refinement", "prior"):
        (same / "run0" / f"{stage}.png").unlink()
    with pytest.raises(RequestError, match="has no turntable yet"):
        write_study([ours, same], tmp_path / "out2", 0)
