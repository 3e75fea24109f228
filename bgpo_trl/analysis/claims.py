"""Tests of the paper's claims, and of the additions to its algorithm, on finished runs."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

from bgpo_trl.analysis.comparison import Run, area_scores, late_scores
from bgpo_trl.analysis.intervals import Statistics
from bgpo_trl.analysis.paper_runs import (
    ADDITIONS,
    ALGORITHMS,
    PUBLISHED,
    PUBLISHED_VARIANTS,
    SETTINGS,
    variant,
)
from bgpo_trl.analysis.tables import Table

Groups = Mapping[str, Mapping[str, Run]]
"""Runs by directory name, by group key."""

LEVEL = (
    "The interval of the difference decides. Level: it includes 0, which does not prove that the "
    "two are equal."
)
_NAMES = ALGORITHMS | PUBLISHED
_MEASURES = {"last 10 %": late_scores, "area": area_scores}
_RIVALS = ("MAML", "Dist-NLL")
# Each BGPO with the baselines under the same conditions (demonstrations, stabilizers).
_PAIRS = {
    "bgpo": ("maml-demonstrations", "dist-nll-demonstrations"),
    "bgpo-experts": ("maml", "dist-nll"),
    "bgpo-single": ("maml", "dist-nll"),
    "bgpo-paper": ("maml-paper", "dist-nll-paper"),
}


def claims(groups: Groups, statistics: Statistics) -> Table:
    """Return the table of the paper's claims and their verdicts, headed by its column names."""
    judge = _Judge(groups, statistics, ("reproduced", "the opposite"))
    rows = [["the paper's claim", "tested", "measured", "difference [95 %]", "found"]]
    for setting in SETTINGS:
        for ours, baselines in _PAIRS.items():
            for rival, baseline in zip(_RIVALS, baselines, strict=True):
                pair = [(_group(setting, key), f"{setting}-{key}") for key in (ours, baseline)]
                tested = f"{_NAMES[ours]} against {_NAMES[baseline]}"
                rows += [
                    [f"BGPO above {rival}, {setting}", tested, what, *judge(what, *pair)]
                    for what in _MEASURES
                ]
    for ours, baselines in _PAIRS.items():
        for rival, baseline in zip(_RIVALS, baselines, strict=True):
            four = [
                (_group(setting, key), f"{setting}-{key}")
                for setting in ("continual", "concurrent")
                for key in (ours, baseline)
            ]
            claim = f"the gap to {rival} is larger in the continual setting"
            tested = f"{_NAMES[ours]} against {_NAMES[baseline]}"
            rows.append([claim, tested, "last 10 %", *judge("last 10 %", *four)])
    order = list(PUBLISHED_VARIANTS)
    for better, worse in [*pairwise(order), (order[0], order[-1])]:
        names = PUBLISHED_VARIANTS[better], PUBLISHED_VARIANTS[worse]
        pair = [("ablation", variant("concurrent", name)) for name in (better, worse)]
        claim = f"{names[0]} converges faster than {names[1]}"
        rows.append([claim, "variants of BGPO, one policy", "area", *judge("area", *pair)])
    return rows


def additions(groups: Groups, statistics: Statistics) -> Table:
    """Return the table of the gain of each addition to the paper's algorithm, or an empty one."""
    judge = _Judge(groups, statistics, ("above", "below"))
    rows = [["added", "compared with", "setting", "measured", "difference [95 %]", "found"]]
    steps = [("even-replay", "gwr+r_int"), ("experts", "even-replay")]
    steps += [("demonstrations", "gwr+r_int"), ("all", "experts"), ("all", "gwr+r_int")]
    any_run = False
    for setting, group in (("concurrent", "ablation"), ("continual", "ablation-continual")):
        for more, fewer in steps:
            pair = [(group, variant(setting, name)) for name in (more, fewer)]
            any_run |= all(key in groups[group] for _, key in pair)
            rows += [
                [ADDITIONS[more], ADDITIONS[fewer], setting, what, *judge(what, *pair)]
                for what in _MEASURES
            ]
    return rows if any_run else []


def _group(setting: str, algorithm: str) -> str:
    return f"{setting}-paper" if algorithm in PUBLISHED else setting


class _Judge:
    """Differences between runs, with intervals and verdicts.

    ``words`` are the verdicts for a difference above 0 and below 0.
    """

    def __init__(self, groups: Groups, statistics: Statistics, words: tuple[str, str]) -> None:
        self._groups, self._statistics, self._words = groups, statistics, words

    def __call__(self, what: str, *keys: tuple[str, str]) -> list[str]:
        """Return a difference of measure ``what`` with its interval, and the verdict.

        ``keys`` are group and directory of two runs, for first minus second; or of four runs, for
        the difference of the first two minus that of the last two.
        """
        runs = [self._groups[group].get(key) for group, key in keys]
        missing = [key for (_, key), run in zip(keys, runs, strict=True) if run is None]
        if missing:
            return ["", "missing: " + ", ".join(missing)]
        scores = [_MEASURES[what](run) for run in runs if run is not None]
        found = self._statistics.difference(*scores)
        above, below = self._words
        return [found.cell(), above if found.low > 0 else below if found.high < 0 else "level"]
