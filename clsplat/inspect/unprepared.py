"""What a preparation would say of a folder of photographs without cameras."""

from collections.abc import Iterator

from clsplat.errors import amount, in_shell
from clsplat.inspect.finding import Finding
from clsplat.inspect.survey import Facts
from clsplat.prepare.gather import MIN_PHOTOGRAPHS
from clsplat.prepare.gather import remedy as remedy_of
from clsplat.prepare.messages import left_out


def unprepared(facts: Facts) -> Iterator[Finding]:
    """Yield that there are no cameras, and how to find them; then the files that a preparation leaves out."""
    count, damaged = facts.on_disk, facts.looks.unreadable
    if facts.kind != "none" or not (count or facts.left_out):
        return
    held = f"{amount(count, 'photograph')} but" if count else "no photographs that can be read, and"
    readable = count - len(damaged)
    if count < MIN_PHOTOGRAPHS:  # told with the files that are left out
        remedy, texts = facts.refusal.removeprefix(f"{facts.path}: "), []
    else:
        remedy, texts = f"`clsplat run photos --scene {in_shell(facts.path)}` finds the cameras", facts.left_out
        if readable < MIN_PHOTOGRAPHS:
            remedy = f"only {readable} of {count} photographs can be read; {remedy_of(damaged)}"
    yield Finding("error", f"{facts.path} holds {held} no camera poses", remedy)
    for text in texts + left_out({"damaged": damaged, "photographs": readable}):
        yield Finding("warning", text.removeprefix(f"{facts.path}: "))
