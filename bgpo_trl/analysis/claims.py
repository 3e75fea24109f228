"""The paper's claims, tested on finished runs."""

from __future__ import annotations

from itertools import product

from bgpo_trl.analysis import statistics
from bgpo_trl.analysis.comparison import NAMES, Setting
from bgpo_trl.analysis.scores import area_scores, late_scores
from bgpo_trl.analysis.tables import Table

_MEASURES = {"success": late_scores, "area": area_scores}
# Each BGPO with the baselines on the same terms (demonstrations, stabilizers).
_PAIRS = {
    "bgpo": ("maml-demonstrations", "dist-nll-demonstrations"),
    "bgpo-experts": ("maml", "dist-nll"),
    "bgpo-single": ("maml", "dist-nll"),
    "bgpo-paper": ("maml-paper", "dist-nll-paper"),
}
_RIVALS = ("MAML", "Dist-NLL")
# Fig. 9, from the best to the worst.
_ABLATION = (
    ("bgpo-single", "without-bonus"),
    ("without-bonus", "without-gwr"),
    ("without-gwr", "without-both"),
    ("bgpo-single", "without-both"),
)
_WORDS = {"above": "reproduced", "below": "the opposite"}


def claims(continual: Setting | None, concurrent: Setting | None) -> tuple[Table, int]:
    """Return the table of the paper's claims, and how many lack runs.

    Args:
        continual: Runs with tasks one after the other, if there are any.
        concurrent: Runs of the same tasks from the start.
    """
    rows = [["the paper's claim", "tested", "measured", "difference", "found"]]
    missing = 0
    settings = {"one after the other": continual, "from the start": concurrent}
    for how, setting in settings.items():
        for ours, rivals in _PAIRS.items():
            for (name, rival), what in product(zip(_RIVALS, rivals, strict=True), _MEASURES):
                cells = _difference(what, (setting, ours), (setting, rival))
                if cells:
                    tested = f"{NAMES[ours]} against {NAMES[rival]}"
                    rows.append([f"BGPO above {name}, {how}", tested, what, *cells])
                missing += not cells
    for ours, rivals in _PAIRS.items():
        for name, rival in zip(_RIVALS, rivals, strict=True):
            four = [(setting, key) for setting in settings.values() for key in (ours, rival)]
            cells = _difference("success", *four)
            if cells:
                claim = f"the lead over {name} is larger one after the other"
                tested = f"{NAMES[ours]} against {NAMES[rival]}"
                rows.append([claim, tested, "success", *cells])
            missing += not cells
    for better, worse in _ABLATION:
        cells = _difference("area", (concurrent, better), (concurrent, worse))
        if cells:
            claim = f"{NAMES[better]} converges faster than {NAMES[worse]}"
            rows.append([claim, "from the start", "area", *cells])
        missing += not cells
    return (rows if len(rows) > 1 else []), missing


def _difference(what: str, *runs: tuple[Setting | None, str]) -> list[str]:
    """Return the difference of two runs or of two pairs of runs, and the verdict; or nothing."""
    scores = []
    for setting, algorithm in runs:
        found = setting.find(algorithm) if setting else None
        if found is None:
            return []
        scores.append(_MEASURES[what](found[1]).mean(1))
    difference = statistics.difference(*scores)
    return [difference.estimate.points(), _WORDS.get(difference.verdict, difference.note)]
