"""The words of the caption grammar beside nouns: colours, materials, patterns, sizes and what is ignored."""

from __future__ import annotations

from dataclasses import dataclass

Color = tuple[float, float, float]


def _rgb(code: str) -> Color:
    return (int(code[0:2], 16) / 255.0, int(code[2:4], 16) / 255.0, int(code[4:6], 16) / 255.0)


COLORS: dict[str, Color] = {
    name: _rgb(code)
    for name, code in {
        "red": "c8342c",
        "crimson": "9e1b32",
        "maroon": "6e1f26",
        "orange": "e8822a",
        "coral": "f07f62",
        "peach": "f6bd96",
        "yellow": "f2c838",
        "mustard": "c99a2c",
        "lime": "a5cc3c",
        "green": "4c9a48",
        "olive": "7d8038",
        "mint": "a5dcc0",
        "teal": "1f8a86",
        "turquoise": "45c1c0",
        "cyan": "48c6e0",
        "blue": "3268c4",
        "navy": "22345f",
        "indigo": "473d94",
        "purple": "7d4aa6",
        "violet": "9a6fd0",
        "lavender": "bcaee0",
        "magenta": "c43b8e",
        "pink": "ee9ab4",
        "brown": "7d5236",
        "tan": "cfa97c",
        "beige": "e4d4b4",
        "cream": "f3e9d0",
        "white": "f2f0ea",
        "grey": "8c8f92",
        "charcoal": "45484c",
        "black": "232427",
    }.items()
}
"""sRGB-encoded, in [0, 1]."""

COLOR_SYNONYMS = {
    "gray": "grey",
    "scarlet": "red",
    "burgundy": "maroon",
    "aqua": "cyan",
    "azure": "blue",
    "lilac": "lavender",
    "ivory": "cream",
    "khaki": "tan",
    "rose": "pink",
    "fuchsia": "magenta",
    "emerald": "green",
    "amber": "orange",
    "blonde": "tan",
    "ebony": "black",
}

SHADES = {
    "light": 0.45,
    "pale": 0.6,
    "bright": 0.0,
    "vivid": 0.0,
    "dark": -0.42,
    "deep": -0.3,
}
"""How far a colour goes towards white (positive) or black (negative)."""


@dataclass(frozen=True)
class MaterialWord:
    """What a material word changes.

    preset:  physical preset (`gdpro_sim.materials`)
    color:   base colour where the prompt names none, or None to keep the object's own
    second:  the other colour of its texture
    texture: a pattern name, or None for a plain surface
    """

    preset: str
    color: Color | None
    second: Color | None = None
    texture: str | None = None


MATERIALS: dict[str, MaterialWord] = {
    "wood": MaterialWord("wood", _rgb("b98350"), _rgb("8d5c33"), "grain"),
    "ceramic": MaterialWord("ceramic", None),
    "metal": MaterialWord("steel", _rgb("b4b9bf"), _rgb("8f959c"), "brushed"),
    "aluminium": MaterialWord("aluminium", _rgb("cdd1d4"), _rgb("b0b5ba"), "brushed"),
    "gold": MaterialWord("gold", _rgb("dcab3c"), _rgb("b98625"), "brushed"),
    "silver": MaterialWord("silver", _rgb("d4d6da"), _rgb("adb1b8"), "brushed"),
    "copper": MaterialWord("copper", _rgb("c27746"), _rgb("9c5832"), "brushed"),
    "stone": MaterialWord("stone", _rgb("9c978c"), _rgb("77736b"), "mottled"),
    "marble": MaterialWord("stone", _rgb("ece9e4"), _rgb("8f8e92"), "marbled"),
    "brick": MaterialWord("brick", _rgb("a9543c"), _rgb("d8cbb8"), "bricks"),
    "concrete": MaterialWord("concrete", _rgb("a8a8a4"), _rgb("8f8f8b"), "mottled"),
    "clay": MaterialWord("ceramic", _rgb("bf6f48"), _rgb("a95d3a"), "mottled"),
    "glass": MaterialWord("glass", _rgb("bcd9d8")),
    "plastic": MaterialWord("plastic", None),
    "rubber": MaterialWord("rubber", None),
    "silicone": MaterialWord("silicone", None),
    "jelly": MaterialWord("jelly", _rgb("d8495c")),
    "foam": MaterialWord("foam", None),
    "plush": MaterialWord("plush", None),
    "leather": MaterialWord("leather", _rgb("8a5330"), _rgb("734325"), "mottled"),
    "wax": MaterialWord("wax", _rgb("efe0b8")),
    "paper": MaterialWord("paper", _rgb("ede6d6")),
    "ice": MaterialWord("ice", _rgb("cfe8f2"), _rgb("a9d2e6"), "mottled"),
    "chocolate": MaterialWord("chocolate", _rgb("5d3622")),
}

MATERIAL_SYNONYMS = {
    "wooden": "wood",
    "oak": "wood",
    "bamboo": "wood",
    "porcelain": "ceramic",
    "earthenware": "clay",
    "terracotta": "clay",
    "steel": "metal",
    "iron": "metal",
    "metallic": "metal",
    "aluminum": "aluminium",
    "tin": "aluminium",
    "golden": "gold",
    "brass": "gold",
    "bronze": "copper",
    "silvery": "silver",
    "granite": "stone",
    "rubbery": "rubber",
    "fabric": "plush",
    "cloth": "plush",
    "felt": "plush",
    "knitted": "plush",
    "woollen": "plush",
    "woolen": "plush",
    "fluffy": "plush",
    "gelatin": "jelly",
    "gummy": "jelly",
    "cardboard": "paper",
    "icy": "ice",
    "frozen": "ice",
}

PATTERNS: dict[str, tuple[str, ...]] = {
    "striped": ("stripes", "stripy", "stripey", "banded"),
    "dotted": ("dots", "polka dot", "polka dots", "polka dotted", "spotted", "spots", "spotty", "dotty"),
    "checkered": ("checker", "checked", "chequered", "checkerboard", "checks"),
    "spiral": ("spirals", "swirl", "swirly", "swirled", "swirls", "twisted"),
    "gradient": ("ombre", "fading"),
    "marbled": ("marbling", "veined"),
    "zigzag": ("zigzags", "zig zag", "chevron", "chevrons"),
    "plaid": ("tartan", "gingham"),
    "speckled": ("speckles", "speckle", "freckled", "flecked"),
}
"""Pattern words and other ways to say them."""

SIZES = {"tiny": 0.4, "small": 0.7, "big": 1.5, "huge": 2.5, "giant": 5.0}
"""Factor on the object's usual size."""

SIZE_SYNONYMS = {
    "mini": "tiny",
    "miniature": "tiny",
    "little": "small",
    "large": "big",
    "enormous": "huge",
    "gigantic": "giant",
}

IGNORED = (
    # What a picture is called.
    "a dslr photo of",
    "dslr photo of",
    "dslr photograph of",
    "a dslr photograph of",
    "a photo of",
    "photo of",
    "a photograph of",
    "photograph of",
    "a picture of",
    "picture of",
    "an image of",
    "image of",
    "a render of",
    "render of",
    "a 3d render of",
    "3d render of",
    "a 3d model of",
    "3d model of",
    "3d asset of",
    "a 3d asset of",
    "a zoomed out dslr photo of",
    "zoomed out",
    "close up of",
    "a close up of",
    "close-up of",
    "dslr photo",
    "dslr",
    "photo",
    "3d render",
    "3d model",
    "3d",
    # Quality and light.
    "8k uhd",
    "8k",
    "4k",
    "hd",
    "uhd",
    "hdr",
    "raw",
    "studio lighting",
    "studio light",
    "soft lighting",
    "cinematic lighting",
    "natural lighting",
    "dramatic lighting",
    "high quality",
    "best quality",
    "highly detailed",
    "very detailed",
    "extremely detailed",
    "intricate details",
    "intricate",
    "detailed",
    "high resolution",
    "high detail",
    "ultra realistic",
    "photorealistic",
    "photo realistic",
    "hyperrealistic",
    "realistic",
    "realism",
    "sharp focus",
    "in focus",
    "masterpiece",
    "award winning",
    "trending on artstation",
    "unreal engine",
    "octane render",
    "ray tracing",
    "depth of field",
    "bokeh",
    "cinematic",
    "professional photography",
    "product photography",
    "professional",
    # Backgrounds.
    "on a white background",
    "white background",
    "on a black background",
    "black background",
    "on a plain background",
    "plain background",
    "simple background",
    "isolated",
    "centered",
    "centred",
    "full body",
    # Praise.
    "beautiful",
    "cute",
    "lovely",
    "pretty",
    "nice",
    "charming",
    "adorable",
    "elegant",
    "stylish",
    "perfect",
    "simple",
    "classic",
    "shiny",
    "glossy",
    "smooth",
)
"""Phrases about pictures rather than objects: skipped, and listed in the spec."""

ARTICLES = {"a", "an", "the", "one", "single", "my", "your", "its", "some", "this", "that"}
JOINERS = {
    "and",
    "with",
    "in",
    "of",
    "made",
    "from",
    "has",
    "having",
    "colored",
    "coloured",
    "out",
    "on",
    ",",
    "&",
}
COUNTS = {
    "two",
    "three",
    "four",
    "five",
    "six",
    "several",
    "many",
    "both",
    "pair",
    "couple",
    "dozen",
    "multiple",
}


def mix(a: Color, b: Color, weight: float) -> Color:
    """a (1 - weight) + b weight."""
    return tuple(x + (y - x) * weight for x, y in zip(a, b, strict=True))  # type: ignore[return-value]


def shaded(color: Color, amount: float) -> Color:
    """Towards white by `amount`, or towards black where it is negative."""
    return mix(color, (1.0, 1.0, 1.0) if amount > 0 else (0.0, 0.0, 0.0), abs(amount))


def luminance(color: Color) -> float:
    """Rec. 709 weights on encoded values: enough to tell light from dark."""
    return 0.2126 * color[0] + 0.7152 * color[1] + 0.0722 * color[2]


def contrasting(color: Color) -> Color:
    """A second colour for a pattern that names one only: cream on dark, a deep shade on light."""
    return shaded(color, -0.62) if luminance(color) > 0.72 else COLORS["cream"]


__all__ = [
    "ARTICLES",
    "COLORS",
    "COLOR_SYNONYMS",
    "COUNTS",
    "IGNORED",
    "JOINERS",
    "MATERIALS",
    "MATERIAL_SYNONYMS",
    "PATTERNS",
    "SHADES",
    "SIZES",
    "SIZE_SYNONYMS",
    "Color",
    "MaterialWord",
    "contrasting",
    "luminance",
    "mix",
    "shaded",
]
