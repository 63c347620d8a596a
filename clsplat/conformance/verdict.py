"""The verdict on a device, in words."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from clsplat.conformance.supervision import Result
from clsplat.opencl.kernel_caches import kernel_caches

BITONIC = {"count_pairs", "fill_tiles", "sort_tiles"}  # what `rasterizer.sort: radix` does without
REPORT = "report it with the file of `clsplat doctor --html FILE`"
REMEDY = f"update the device's driver or take another device (`clsplat devices` lists them), and {REPORT}"


@dataclass(frozen=True)
class Verdict:
    """Whether to use a device, and how."""

    usable: bool
    text: str
    advice: str = ""  # what to do about what is wrong

    @property
    def level(self) -> Literal["ready", "warning", "error"]:
        return "error" if not self.usable else "warning" if self.advice else "ready"


def judge(default: str, schedules: Mapping[str, Sequence[Result]], once: Sequence[Result]) -> Verdict:
    """Judge the results of each schedule, and of the checks that a device needs `once`."""
    verdict = _of_figures(default, schedules, once)
    if verdict.usable and any(result.damaged_cache for part in (*schedules.values(), once) for result in part):
        advice = f"remove {kernel_caches()}, which fill again" + (f"; {verdict.advice}" if verdict.advice else "")
        return Verdict(True, f"{verdict.text}, once its cache of built kernels, which is damaged, is removed", advice)
    return verdict


def _of_figures(default: str, schedules: Mapping[str, Sequence[Result]], once: Sequence[Result]) -> Verdict:
    failures = {name: [text for result in results for text in result.failures] for name, results in schedules.items()}
    others = [text for result in once for text in result.failures]
    good = [name for name, found in failures.items() if not found]
    if good and (default in good or default not in failures):
        return _with_the_default(good, failures, others)
    if good:
        why = f"with the {default} schedule, {failures[default][0]}"
        return Verdict(True, f"use it with --set rasterizer.schedule={good[0]}: {why}", REMEDY)
    wrong = [result for result in schedules[default] if not result.holds]
    if all(_is_bitonic(result) for result in wrong):
        return Verdict(True, f"use it with --set rasterizer.sort=radix: {failures[default][0]}", REMEDY)
    first, more = failures[default][0], sum(map(len, failures.values())) - 1
    rest = f"; {more} more {'is' if more == 1 else 'are'} wrong" if more else ""
    return Verdict(False, f"do not use it: {first}{rest}", REMEDY)


def _with_the_default(good: list[str], failures: Mapping[str, list[str]], others: list[str]) -> Verdict:
    wrong = [f"with the {name} schedule, {found[0]}" for name, found in failures.items() if found] + others
    if not wrong:
        return Verdict(True, "use it")
    return Verdict(True, f"use it, as it is; but {wrong[0]}", f"nothing for training; {REPORT}")


def _is_bitonic(result: Result) -> bool:
    return result.fault is None and all(figure.kernel in BITONIC for figure in result.figures if not figure.holds)
