"""What a prompt asked for, once understood."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Style:
    """How something looks: colour words ("dark blue"), a material word and a pattern word, as far as said."""

    colors: tuple[str, ...] = ()
    material: str | None = None
    pattern: str | None = None

    def words(self) -> str:
        """The style as a prompt says it: "red and white striped ceramic"."""
        listed = [" and ".join(self.colors), self.pattern or "", self.material or ""]
        return " ".join(word for word in listed if word)

    def describe(self) -> dict[str, Any]:
        """JSON values."""
        return {"colors": list(self.colors), "material": self.material, "pattern": self.pattern}


@dataclass(frozen=True)
class ObjectSpec:
    """One object of the built-in vocabulary.

    prompt:  as given
    noun:    canonical name in `NOUNS`
    size:    a size word or None
    style:   of the whole object
    parts:   styles of parts by name
    ignored: phrases about the picture that were skipped
    unknown: words that were skipped because `ignore_unknown` was set
    """

    prompt: str
    noun: str
    size: str | None = None
    style: Style = Style()
    parts: Mapping[str, Style] = field(default_factory=dict)
    ignored: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()

    def caption(self) -> str:
        """The shortest prompt that means the same; `parse(caption())` gives this spec but for the prompt."""
        words = [self.size or "", self.style.words(), self.noun]
        text = "a " + " ".join(word for word in words if word)
        extras = [f"a {style.words()} {name}" for name, style in self.parts.items()]
        return f"{text} with {' and '.join(extras)}" if extras else text

    def describe(self) -> dict[str, Any]:
        """JSON values for the provenance."""
        return {
            "prompt": self.prompt,
            "caption": self.caption(),
            "noun": self.noun,
            "size": self.size,
            "style": self.style.describe(),
            "parts": {name: style.describe() for name, style in self.parts.items()},
            "ignored": list(self.ignored),
            "unknown": list(self.unknown),
        }


__all__ = ["ObjectSpec", "Style"]
