"""Sections of a report: success, differences, forgetting and transfer, learning times, groups.

Sections that not every setting has come as a list, which may be empty.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from matplotlib.figure import Figure

from bgpo_trl.analysis import statistics
from bgpo_trl.analysis.comparison import Setting
from bgpo_trl.analysis.scores import (
    Values,
    area_scores,
    demonstrated_steps,
    final_means,
    forgetting,
    forward_transfer,
    known_mean,
    late_scores,
    own_episodes,
    success_matrix,
    success_steps,
)
from bgpo_trl.runs.results import Run

Table = list[list[str]]
"""Rows of cells; the first row holds the column names."""
Figures = dict[str, tuple[str, Figure]]
"""File names and figures by caption."""


@dataclass(frozen=True)
class Section:
    """Section of a report: title, table, figures and notes."""

    title: str
    table: Table = field(default_factory=list)
    """Omitted if empty."""
    figures: Figures = field(default_factory=dict)
    notes: Sequence[str] = ()


# Beside BGPO: its versions and the baselines on the same terms; with and without an addition.
_PAIRS = {
    *(("bgpo-experts", rival) for rival in ("maml", "dist-nll")),
    *(("bgpo-single", rival) for rival in ("maml", "dist-nll")),
    *(("bgpo-paper", rival) for rival in ("maml-paper", "dist-nll-paper")),
    *(("bgpo-single", fewer) for fewer in ("without-bonus", "without-gwr", "without-both")),
    *(("without-bonus", "without-both"), ("without-gwr", "without-both")),
    *(("group-balanced-replay", "bgpo-single"), ("demonstrations", "bgpo-single")),
    ("bgpo-experts", "group-balanced-replay"),
}


def success_section(setting: Setting) -> Section:
    """Return the conditions of a setting, and the success of its runs."""
    first = setting.first
    conditions = {name: first.config.get(name) for name in ("held_out", "eval_episodes")}
    tasks = ", ".join(
        f"{number} {task} (from episode {start})"
        for number, (task, start) in enumerate(first.presented.items(), 1)
    )
    tests = [f"{name} {value}" for name, value in conditions.items() if value is not None]
    notes = (
        f"Tasks: {tasks}. {first.config['episodes']:,} episodes, "
        + ", ".join([f"tests every {first.eval_every}", *tests])
        + ".",
        "The seed is the unit: its score is the mean over tasks of the success in tests over the "
        "last 10 % of training, its area the mean height of the tasks' curves of test success "
        "since they were presented. Given are means over seeds and 95 % intervals (Student's t), "
        "in percent.",
        "Worst task: that with the lowest mean. Steps: of the successful tests among these, and of "
        "the demonstrations; means over the tasks with a success.",
    )
    numbers = range(1, len(setting.first.tasks) + 1)
    rows = [["", "knows of tasks", "seeds", "success", "worst task"]]
    rows[0] += [*(f"task {number}" for number in numbers), "steps", "demonstrated", "area"]
    for name, run in setting.runs.items():
        late, area = late_scores(run), area_scores(run)
        worst = int(late.mean(0).argmin())
        row = [name, _knows(run), str(len(late)), statistics.mean(late.mean(1)).percent()]
        row += [f"{statistics.mean(late[:, worst]).percent()}, task {worst + 1}"]
        row += [f"{100 * share:.1f}" for share in late.mean(0)]
        steps, demonstrated = known_mean(success_steps(run)), demonstrated_steps(run)
        solved = ~np.isnan(steps)
        row += [_mean_cell(steps[solved]), _mean_cell(demonstrated[solved])]
        rows.append([*row, statistics.mean(area.mean(1)).percent()])
    return Section(setting.title, rows, notes=notes)


def _mean_cell(steps: Values) -> str:
    """Format the mean of the steps of some tasks; "-" without tasks, or where one is unknown."""
    return f"{steps.mean():.1f}" if len(steps) and np.isfinite(steps).all() else "-"


def _knows(run: Run) -> str:
    """Return what the algorithm is given of the tasks, from ``summary.json``."""
    given = {"label": "needs_label", "boundaries": "needs_boundaries"}
    known = [name for name, key in given.items() if run.summary.get(key)]
    return ", ".join(known) or ("nothing" if "needs_label" in run.summary else "?")


def difference_section(setting: Setting) -> list[Section]:
    """Return the differences from BGPO, or from the first run.

    With it come the pairs that differ in one part, or are on the same terms.
    """
    named = {name: run.algorithm for name, run in setting.runs.items()}
    first = next((name for name, key in named.items() if key == "bgpo"), next(iter(named)))
    pairs = [(first, other) for other in named if other != first]
    pairs += [
        pair
        for both in combinations(named, 2)
        for pair in (both, both[::-1])
        if (named[pair[0]], named[pair[1]]) in _PAIRS and pair not in pairs
    ]
    rows = [["", "success", "found", "p", "area", "found"]]
    for pair in pairs:
        runs = [setting.runs[name] for name in pair]
        late, area = ([score(run).mean(1) for run in runs] for score in (late_scores, area_scores))
        p = statistics.permutation_p(*late)
        cells = [
            cell
            for found in (statistics.difference(*late), statistics.difference(*area))
            for cell in (found.estimate.points(), found.verdict)
        ]
        cells.insert(2, "-" if np.isnan(p) else f"{p:.3f}")
        rows.append([" against ".join(pair), *cells])
    notes = (
        "Differences of the seeds' scores in points, with 95 % intervals (Welch's t). Above, "
        "below: the interval excludes 0. Equivalent: the 90 % interval lies within "
        f"+-{100 * statistics.MARGIN:.0f} points, a margin set beforehand. Else it is not decided. "
        "p: permutation test of seeds, two-sided. Nothing is adjusted for the number of rows.",
    )
    return [Section(f"Differences: {setting.title}", rows, notes=notes)] if pairs else []


def sequence_section(setting: Setting, reference: Setting | None) -> Section:
    """Return forgetting and transfer in a setting with tasks one after the other."""
    rows = [["", "forgetting", "forward transfer"]]
    for name, run in setting.runs.items():
        beside = reference.find(run) if reference is not None else None
        forward = None if beside is None else forward_transfer(run, beside)
        forgotten = statistics.mean(forgetting(success_matrix(run)).mean(1)).points()
        rows.append([name, forgotten, forward.points() if forward else "-"])
    notes = (
        "Means over seeds and 95 % intervals, in points. Forgetting: mean over tasks of R[j, j] "
        "minus R at the end. R[i, j] is the success on task j at the end of the phase of "
        "task i, over as many episodes as the last fifth of the shortest phase has.",
        "Forward transfer: (area - reference) / (1 - reference), areas under a task's curve over "
        "its own episodes, from the first to the last test of its phase; reference: the same "
        "algorithm with all tasks from the start, whose seeds count in the interval.",
    )
    return Section(f"Forgetting and transfer: {setting.title}", rows, notes=notes)


def speed_section(setting: Setting, share: float) -> list[Section]:
    """Return learning times: each task's own training episodes to a success rate."""
    note = (
        "Training episodes of a task's own until so many of its last 20 succeed: median over "
        "seeds, in which a seed that never gets there counts as longest."
    )
    rows = [["", *(f"task {number}" for number, _ in enumerate(setting.first.tasks, 1))]]
    for name, run in setting.runs.items():
        episodes = own_episodes(run, share)
        if episodes is not None:
            rows.append([name, *map(_median_cell, episodes.T)])
    title = f"Own episodes to {100 * share:.0f} %: {setting.title}"
    return [Section(title, rows, notes=[note])] if len(rows) > 1 else []


def _median_cell(episodes: Values) -> str:
    """Format the median of learning times ``[S]``, and the number of infinite ones."""
    never = int(np.isinf(episodes).sum())
    median = float(np.median(episodes))
    cell = f"{median:.0f}" if np.isfinite(median) else "not reached"
    return f"{cell} ({never} of {len(episodes)} seeds never)" if never else cell


def groups_section(setting: Setting) -> list[Section]:
    """Return nodes, groups, purity and task inference of the runs with GWR-B."""
    rows = [["", "groups", "purity, %", "tasks inferred, %", "by seed", "nodes of GWR-B"]]
    for name, run in setting.runs.items():
        if run.summary.get("nodes") is None:
            continue
        groups, purity = run.summary.get("groups"), run.summary.get("group_purity")
        inferred = final_means(run, "held-out", "task_inference")
        of_seeds = [] if inferred is None else (100 * inferred.mean(1)).tolist()
        rows.append(
            [
                name,
                "one for all" if groups is None else _numbers(groups),
                _numbers([100 * share for share in purity or ()], 1),
                f"{np.mean(of_seeds):.2f}" if of_seeds else "",
                _numbers(of_seeds, 1),
                _numbers(run.summary["nodes"]),
            ]
        )
    return [Section(f"GWR-B, by seed: {setting.title}", rows)] if len(rows) > 1 else []


def cost_section(setting: Setting) -> list[Section]:
    """Return the cost of training by the number of presented tasks, of all seeds."""
    note = "Of all seeds together, without tests: time of a training step, and memory."
    # Runs of single seeds, joined, are added up.
    costs = {
        name: run.costs.assign(
            ms=1000 * run.costs["seconds"] / run.costs["steps"].where(run.costs["steps"] > 0)
        )
        .groupby("tasks")
        .sum()
        for name, run in setting.runs.items()
        if run.costs is not None and len(run.costs)
    }
    numbers = sorted({tasks for of_run in costs.values() for tasks in of_run.index})
    rows = [["", "hours", *(f"{number} task{'s' * (number > 1)}" for number in numbers)]]
    for name, of_run in costs.items():
        milliseconds, megabytes = of_run["ms"], of_run["megabytes"]
        cells = [
            f"{milliseconds[number]:.1f} ms, {megabytes[number]:.0f} MB"
            if number in of_run.index and of_run["steps"][number]
            else "-"
            for number in numbers
        ]
        rows.append([name, f"{of_run['seconds'].sum() / 3600:.1f}", *cells])
    return [Section(f"Cost: {setting.title}", rows, notes=[note])] if costs else []


def run_section(title: str, run: Run) -> Section:
    """Return a run, task by task."""
    late = late_scores(run)
    seen, held_out = (final_means(run, kind, "success") for kind in ("seen", "held-out"))
    inferred = final_means(run, "held-out", "task_inference")
    trained = final_means(run, "held-out", "steps")
    steps = [
        *(None if found is None else known_mean(found) for found in (success_steps(run), trained)),
        demonstrated_steps(run),
    ]
    rows = [["task", "last 10 %", "by seed", "trained, seen", "trained, held-out", "inferred"]]
    rows[0] += ["steps", "steps, trained", "steps, demonstrated"]
    # The last row is the mean over tasks.
    for index, task in enumerate([*run.tasks, None]):
        chosen = slice(None) if task is None else slice(index, index + 1)
        of_seeds = late[:, chosen].mean(1)
        rows.append(
            [
                task or "all",
                statistics.mean(of_seeds).percent(),
                _numbers((100 * of_seeds).tolist()),
                *(
                    "" if shares is None else f"{100 * shares[:, chosen].mean():.{digits}f}"
                    for shares, digits in ((seen, 1), (held_out, 1), (inferred, 2))
                ),
                *("" if of_tasks is None else _mean_cell(of_tasks[chosen]) for of_tasks in steps),
            ]
        )
    known = [f"`{run.summary[key]}`" for key in ("commit", "command") if run.summary.get(key)]
    return Section(title, rows, notes=[", ".join(known)])


def _numbers(values: Iterable[float], digits: int = 0) -> str:
    """Join numbers with spaces, dropping a decimal of 0."""
    return " ".join(f"{value:.{digits}f}".removesuffix(".0") for value in values)


def markdown(rows: Table) -> str:
    """Format a table in Markdown; columns of numbers are aligned on the right."""
    head, *body = ([cell.replace("|", r"\|") for cell in row] for row in rows)
    numbers = [
        all(cell[:1] in "+-0123456789" for cell in cells) for cells in zip(*body, strict=True)
    ]
    lines = [head, ["---:" if number else "---" for number in numbers], *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
