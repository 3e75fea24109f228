"""Names, groups and figures of the runs that repeat the paper's experiments."""

from __future__ import annotations

from bgpo_trl.analysis.comparison import Group, Picture

REFERENCES = {"oracle": "DDPG, told the label", "ddpg": "DDPG, told nothing"}
ALGORITHMS = {
    "bgpo": "BGPO",
    "bgpo-experts": "BGPO without demonstrations",
    "bgpo-single": "BGPO, one policy",
    "maml": "MAML",
    "maml-demonstrations": "MAML + demonstrations",
    "dist-nll": "Dist-NLL",
    "dist-nll-demonstrations": "Dist-NLL + demonstrations",
    **REFERENCES,
}
PUBLISHED = {
    "bgpo-paper": "BGPO as published",
    "maml-paper": "MAML as published",
    "dist-nll-paper": "Dist-NLL as published",
}
SETTINGS = {
    "concurrent": ("6", "all tasks from the start"),
    "continual": ("8", "tasks one after the other"),
}
"""Number of the paper's figure, and its schedule of tasks."""
# Variants that are also algorithms, run once under the algorithm's name.
SAME = {"gwr+r_int": "bgpo-single", "experts": "bgpo-experts", "all": "bgpo"}
PUBLISHED_VARIANTS = {
    "gwr+r_int": "GWR-B + r_int",
    "gwr": "GWR-B",
    "r_int": "r_int",
    "none": "none",
}
ADDITIONS = {
    "gwr+r_int": "GWR-B + r_int",
    "even-replay": "+ even replay",
    "experts": "+ even replay + experts",
    "demonstrations": "+ demonstrations",
    "all": "+ all three",
}


def variant(setting: str, name: str) -> str:
    """Return the directory of a variant's run."""
    if name in SAME:
        return f"{setting}-{SAME[name]}"
    return f"ablation-{name}" if setting == "concurrent" else f"ablation-continual-{name}"


def _compared(setting: str) -> Group:
    number, title = SETTINGS[setting]
    alone = ("bgpo-experts", "maml", "dist-nll", *REFERENCES, "bgpo-single")
    shown = ("bgpo", "maml-demonstrations", "dist-nll-demonstrations", *REFERENCES)

    def picture(file: str, caption: str, algorithms: tuple[str, ...]) -> Picture:
        return Picture(file, caption, tuple(f"{setting}-{key}" for key in algorithms))

    return Group(
        f"Fig. {number}: {title}",
        {f"{setting}-{key}": name for key, name in ALGORITHMS.items()},
        (
            picture(f"fig{number}", "with demonstrations as experience", shown),
            picture(f"fig{number}-without", "without demonstrations as experience", alone),
        ),
    )


def _published(setting: str) -> Group:
    number, title = SETTINGS[setting]
    runs = {f"{setting}-{key}": name for key, name in PUBLISHED.items()}
    picture = Picture(f"fig{number}-published", "no stabilizers, small networks", tuple(runs))
    return Group(f"Fig. {number} as published: {title}", runs, (picture,))


def _ablation(setting: str) -> Group:
    published = {variant(setting, key): name for key, name in PUBLISHED_VARIANTS.items()}
    added = {variant(setting, key): name for key, name in ADDITIONS.items()}
    references = {f"{setting}-{key}": name for key, name in REFERENCES.items()}
    file = "fig9" if setting == "concurrent" else f"fig9-{setting}"
    return Group(
        f"Fig. 9: contribution of each part, {SETTINGS[setting][1]}",
        {**published, **added, **references},
        (
            Picture(file, "the paper's four", (*published, *references)),
            Picture(f"{file}-added", "additions to them", tuple(added)),
        ),
    )


GROUPS = {setting: _compared(setting) for setting in SETTINGS}
GROUPS |= {f"{setting}-paper": _published(setting) for setting in SETTINGS}
GROUPS |= {"ablation": _ablation("concurrent"), "ablation-continual": _ablation("continual")}
