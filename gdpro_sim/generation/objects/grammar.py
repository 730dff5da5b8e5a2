"""From a caption to an `ObjectSpec`: one object, its style, the styles of its parts.

    [size] [style] noun [made of material] [in colour] [with [style] part [and [style] part] ...]
    style = colours, a material, a pattern, in any order ("red and white striped", "dark blue ceramic")

Phrases about the picture ("a DSLR photo of", "8k") are skipped and listed. Everything else must be known.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass, field
from functools import cache

from gdpro_sim.errors import GuidanceError
from gdpro_sim.generation.objects import words as w
from gdpro_sim.generation.objects.parts import NOUNS, Noun
from gdpro_sim.generation.objects.spec import ObjectSpec, Style

LONGEST = 5
"""Words in the longest phrase of the vocabulary."""

IRREGULAR = {
    "dice": "die",
    "loaves": "loaf",
    "knives": "knife",
    "leaves": "leaf",
    "shelves": "shelf",
    "mice": "mouse",
    "feet": "foot",
    "teeth": "tooth",
    "tomatoes": "tomato",
    "potatoes": "potato",
    "cactuses": "cactus",
    "cacti": "cactus",
}


def singular(word: str) -> str:
    """`word` without its plural ending; the last word of a phrase."""
    *before, last = word.split(" ")
    if last in IRREGULAR:
        last = IRREGULAR[last]
    elif last.endswith("ies") and len(last) > 4:
        last = last[:-3] + "y"
    elif last.endswith(("ches", "shes", "sses", "xes", "zes")):
        last = last[:-2]
    elif last.endswith("s") and not last.endswith(("ss", "us", "is")):
        last = last[:-1]
    return " ".join([*before, last])


@cache
def _phrases() -> dict[str, dict[str, str]]:
    """Every phrase by kind of word, each with the canonical word it stands for."""
    nouns = {name: n.name for n in NOUNS.values() for name in (n.name, *n.synonyms)}
    patterns = {form: name for name, forms in w.PATTERNS.items() for form in (name, *forms)}
    parts: dict[str, str] = {}
    for known in NOUNS.values():
        for part in known.part_names():
            parts |= {part: part, singular(part): part}
    return {
        "noun": nouns | {singular(n): name for n, name in nouns.items() if singular(n) not in nouns},
        "part": parts,
        "pattern": patterns,
        "material": {m: m for m in w.MATERIALS} | w.MATERIAL_SYNONYMS,
        "color": {c: c for c in w.COLORS} | w.COLOR_SYNONYMS,
        "shade": {s: s for s in w.SHADES},
        "size": {s: s for s in w.SIZES} | w.SIZE_SYNONYMS,
    }


def vocabulary() -> dict[str, list[str]]:
    """Known words by kind; synonyms in brackets after the word they stand for."""

    def listed(names: list[str], synonyms: dict[str, str]) -> list[str]:
        out = []
        for name in names:
            others = [s for s, meant in synonyms.items() if meant == name and s != name]
            out.append(f"{name} ({', '.join(others)})" if others else name)
        return out

    nouns: dict[str, list[str]] = {}
    for known in NOUNS.values():
        forms = f" ({', '.join(known.synonyms)})" if known.synonyms else ""
        nouns.setdefault(known.kind, []).append(known.name + forms)
    patterns = [f"{name} ({', '.join(forms)})" for name, forms in w.PATTERNS.items()]
    return {
        **nouns,
        "colours": listed(list(w.COLORS), w.COLOR_SYNONYMS),
        "shades": list(w.SHADES),
        "materials": listed(list(w.MATERIALS), w.MATERIAL_SYNONYMS),
        "patterns": patterns,
        "sizes": listed(list(w.SIZES), w.SIZE_SYNONYMS),
        "ignored": list(w.IGNORED),
    }


@dataclass(frozen=True)
class _Word:
    """A phrase of the prompt: what it may be ("noun", "part", ...) with its canonical words."""

    text: str
    kinds: dict[str, str]


def _tokens(prompt: str) -> list[str]:
    text = prompt.lower().replace("-", " ").replace("’s", "").replace("'s", "").replace("colour", "color")
    return re.findall(r"[^\W_]+|[,&]", text)


@cache
def _ignored_phrases() -> list[list[str]]:
    """The longest first."""
    return sorted((_tokens(phrase) for phrase in w.IGNORED), key=len, reverse=True)


def _without_ignored(tokens: list[str]) -> tuple[list[str], tuple[str, ...]]:
    phrases = _ignored_phrases()
    ignored: list[str] = []
    out: list[str] = []
    i = 0
    while i < len(tokens):
        for phrase in phrases:
            if tokens[i : i + len(phrase)] == phrase:
                ignored.append(" ".join(phrase))
                i += len(phrase)
                break
        else:
            out.append(tokens[i])
            i += 1
    return out, tuple(ignored)


def _words(tokens: list[str]) -> list[_Word]:
    """Phrases from left to right, the longest known one first; plurals as their singular."""
    phrases = _phrases()
    out = []
    i = 0
    while i < len(tokens):
        for length in range(min(LONGEST, len(tokens) - i), 0, -1):
            text = " ".join(tokens[i : i + length])
            kinds: dict[str, str] = {}
            for kind, known in phrases.items():
                if text in known:
                    kinds[kind] = known[text]
                elif kind == "noun" and singular(text) in known:
                    kinds[kind] = known[singular(text)]
                elif kind == "part" and singular(text) in known:
                    kinds[kind] = known[singular(text)]
            joiner = text in w.JOINERS or text in w.ARTICLES or text in w.COUNTS or text.isdigit()
            if kinds or length == 1:
                out.append(_Word(text, {"joiner": text} if joiner and not kinds else kinds))
                i += length
                break
    return out


def _same_part(text: str, names: list[str]) -> str | None:
    """The one of `names` that is `text` but for plurals."""
    return next((name for name in names if singular(name) == singular(text)), None)


@dataclass
class _Gathered:
    """Attributes read and not yet given to something."""

    colors: list[str] = field(default_factory=list)
    material: str | None = None
    pattern: str | None = None
    shade: str | None = None
    said: list[str] = field(default_factory=list)

    def style(self) -> Style:
        return Style(tuple(self.colors), self.material, self.pattern)


class _Reader:
    def __init__(self, prompt: str, ignore_unknown: bool) -> None:
        self.prompt = prompt
        self.ignore_unknown = ignore_unknown
        tokens, self.ignored = _without_ignored(_tokens(prompt))
        self.unknown: list[str] = []
        self.words = _words(tokens)
        self.size: str | None = None

    def read(self) -> ObjectSpec:
        self._refuse_counts()
        split = next((i for i, word in enumerate(self.words) if word.text in ("with", "has", "having")), None)
        head, tail = (self.words, []) if split is None else (self.words[:split], self.words[split + 1 :])
        noun = self._noun(head)
        style = self._style(head, noun)
        parts: dict[str, Style] = {}
        style = self._clauses(tail, noun, style, parts)
        if self.unknown and not self.ignore_unknown:
            raise self._unknown_error()
        return ObjectSpec(self.prompt, noun.name, self.size, style, parts, self.ignored, tuple(self.unknown))

    def _refuse_counts(self) -> None:
        for word in self.words:
            number = word.text.isdigit() and int(word.text) != 1
            if "joiner" in word.kinds and (word.text in w.COUNTS or number):
                raise self._several(word.text)

    def _several(self, what: str) -> GuidanceError:
        return GuidanceError(
            f"prompt {self.prompt!r} asks for several objects ({what}); generate them one by one and compose "
            "them in a scene file (bodies: ...), see `gdpro simulate --help`"
        )

    @property
    def _way_out(self) -> str:
        prompt = " ".join(self.prompt.replace('"', "'").split())
        return (
            "`gdpro vocabulary` prints every known word; for open prompts: "
            f'gdpro generate "{prompt}" --guidance diffusers --model DIR'
        )

    def _unknown_error(self) -> GuidanceError:
        known = sorted({phrase for kind, words in _phrases().items() if kind != "part" for phrase in words})
        hints = []
        for word in self.unknown:
            near = difflib.get_close_matches(singular(word), known, n=3, cutoff=0.6)
            hints.append(f"{word!r}" + (f" (nearest: {', '.join(near)})" if near else ""))
        return GuidanceError(
            f"prompt {self.prompt!r}: the built-in library does not know {', '.join(hints)}; "
            f"{self._way_out}; or go on without them: --ignore-unknown"
        )

    def _noun(self, head: list[_Word]) -> Noun:
        """The object; a word that may also be a colour or a material is one where another noun is said."""
        sure = [word for word in head if "noun" in word.kinds and not self._is_attribute(word)]
        maybe = [word for word in head if "noun" in word.kinds and self._is_attribute(word)]
        chosen = sure or maybe[-1:]
        names = list(dict.fromkeys(word.kinds["noun"] for word in chosen))
        if len(names) > 1:
            raise self._several(" and ".join(names))
        if not names:
            self.unknown = [word.text for word in self.words if not word.kinds]
            if self.unknown:
                raise self._unknown_error()
            raise GuidanceError(f"prompt {self.prompt!r} names no object; {self._way_out}")
        self._noun_word = chosen[0]
        return NOUNS[names[0]]

    @staticmethod
    def _is_attribute(word: _Word) -> bool:
        return bool({"color", "material", "pattern"} & set(word.kinds))

    def _style(self, head: list[_Word], noun: Noun) -> Style:
        gathered = _Gathered()
        for word in head:
            if word is self._noun_word or (
                word.kinds.get("noun") == noun.name and not self._is_attribute(word)
            ):
                continue
            self._gather(word, gathered)
        return gathered.style()

    def _gather(self, word: _Word, into: _Gathered) -> None:
        kinds = word.kinds
        if "joiner" in kinds:
            return
        if "shade" in kinds:
            into.shade = word.text
        elif "color" in kinds:
            named = kinds["color"] if into.shade is None else f"{into.shade} {kinds['color']}"
            into.shade = None
            into.colors.append(named)
            if len(into.colors) > 2:
                raise GuidanceError(
                    f"prompt {self.prompt!r} gives three colours to one thing ({', '.join(into.colors)}); "
                    'two are possible, and one more for each part ("with a blue handle")'
                )
        elif "pattern" in kinds:
            into.pattern = self._only(into.pattern, kinds["pattern"], "pattern")
        elif "material" in kinds:
            into.material = self._only(into.material, kinds["material"], "material")
        elif "size" in kinds:
            self.size = self._only(self.size, kinds["size"], "size")
        else:
            self.unknown.append(word.text)
            return
        into.said.append(word.text)

    def _only(self, before: str | None, new: str, kind: str) -> str:
        if before is not None and before != new:
            raise GuidanceError(
                f"prompt {self.prompt!r} gives one thing two {kind}s ({before}, {new}); name one"
            )
        return new

    def _clauses(self, tail: list[_Word], noun: Noun, style: Style, parts: dict[str, Style]) -> Style:
        """Read "with ..."; returns the object's style, to which a clause may add a pattern."""
        own = noun.part_names()
        gathered = _Gathered()
        for i, word in enumerate(tail):
            name = _same_part(word.text, own)
            after = tail[i + 1].kinds if i + 1 < len(tail) else {}
            ends = i + 1 == len(tail) or "joiner" in after
            if "shade" in word.kinds and "color" in after:
                name = None
            if name is not None and not (self._is_attribute(word) and not ends):
                if gathered.said:
                    parts[name] = gathered.style()
                gathered = _Gathered()
            elif "pattern" in word.kinds and ends and word.text not in w.PATTERNS:
                style = self._with_pattern(style, gathered, word)
                gathered = _Gathered()
            elif "part" in word.kinds and not self._is_attribute(word) and "shade" not in word.kinds:
                raise GuidanceError(
                    f"prompt {self.prompt!r}: a {noun.name} of the built-in library has no {word.text}; its "
                    f"parts are {', '.join(own)}"
                )
            elif "noun" in word.kinds and not self._is_attribute(word):
                raise self._several(f"{noun.name} and {word.kinds['noun']}")
            else:
                self._gather(word, gathered)
        if gathered.said and not self.unknown:
            raise GuidanceError(
                f"prompt {self.prompt!r}: {' '.join(gathered.said)!r} stands before no part; a {noun.name} "
                f"has {', '.join(own)}"
            )
        return style

    def _with_pattern(self, style: Style, gathered: _Gathered, word: _Word) -> Style:
        """ "a blue mug with white stripes": the pattern's colour is the object's second."""
        pattern = self._only(style.pattern, word.kinds["pattern"], "pattern")
        colors = style.colors
        if gathered.colors:
            first = colors[:1] or (("white",) if gathered.colors[0] != "white" else ("blue",))
            colors = (*first, gathered.colors[0])
        return Style(colors, style.material, pattern)


def parse(prompt: str, *, ignore_unknown: bool = False) -> ObjectSpec:
    """Understand a caption of one object of the built-in vocabulary.

    ignore_unknown: go on without unknown words, listed in `ObjectSpec.unknown`. Raises `GuidanceError` for an
    empty prompt, unknown words (with the nearest known ones), several objects, or a part the object lacks.

        parse("a red mug with a blue handle")
    """
    if not prompt.strip():
        raise GuidanceError('the prompt is empty; say one object, for example "a red mug with a blue handle"')
    return _Reader(prompt, ignore_unknown).read()


__all__ = ["parse", "singular", "vocabulary"]
