"""Make the page about schedules: their notations, and the keys that take them."""

from collections.abc import Callable

from families import NOTATIONS, Kind, families, family, settings_classes, tag, unnamed_settings

from clsplat.core.schedule import Curve, Decay, Every, Points

EXAMPLES = {  # notation: meaning, and how a file writes it
    "A constant": ("The same at every step.", "weight: 0.8"),
    "Points": (
        "Values at global steps, with linear interpolation. The value is constant before the first and after the last "
        "point.",
        "weight: [[4000, 0.0], [5000, 4.0]]      # 0 until step 4000, 4 from step 5000 on",
    ),
}
SAMPLES = {
    Points: "resolution: {points: [[0, 4.0], [500, 2.0], [1000, 1.0]], between: steps}",
    Every: "sh_rest: {every: 4, value: 5.0e-4}",
    Decay: "means: {initial: 1.6e-4, final: 1.6e-6, over: 30000}",
}
TITLES = {Points: "Points with keys", Decay: "Exponential decay", Every: "At intervals"}


def schedule_page(key_table: Callable[[Kind], str]) -> str:
    """Return the page; `key_table` makes the table of a class."""
    text = "# Schedules\n\nA key that takes a *number or schedule* can change over training. "
    text += "All of them share these notations. Steps are global: they count over the whole pipeline, from 1.\n\n"
    for title, (meaning, sample) in EXAMPLES.items():
        text += f"## {title}\n\n{meaning}\n\n```yaml\n{sample}\n```\n\n"
    for kind in NOTATIONS:
        manual = " ".join((kind.__doc__ or "").split())
        text += f"## {TITLES[kind]} {{: #{kind.__name__.lower()} }}\n\n{manual}\n\n{key_table(kind)}"
        text += f"```yaml\n{SAMPLES[kind]}\n```\n\n"
    return f"{text}## Keys that take a schedule\n\n{users_table()}"


def users_table() -> str:
    """Return a table of all keys that take a schedule."""
    named = [
        (f"[`{tag(kind)}`]({family(base).page}.md#{tag(kind)})", kind) for base, ks in families().items() for kind in ks
    ]
    others = [(f"[`{key}`](settings.md#{kind.__name__.lower()})", kind) for kind, key in unnamed_settings().items()]
    rows = ""
    for title, kind in [*others, *named]:
        keys = [f"`{name}`" for name, field in kind.model_fields.items() if Curve in settings_classes(field)]
        rows += f"| {title} | {', '.join(keys)} |\n" if keys else ""
    return f"| part of a pipeline | keys |\n|---|---|\n{rows}\n"
