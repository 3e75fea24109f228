"""Figure of success on each task after each phase of training, as heat maps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import ArrayLike, NDArray

from bgpo_trl.figures.style import readable

_COLUMNS = 3
# Of viridis, on which white letters are readable up to about this height.
_COLOR_MAP, _WHITE_BELOW = "viridis", 0.6


def plot_success_matrices(matrices: Mapping[str, ArrayLike], tasks: Sequence[str]) -> Figure:
    """Plot ``R[i, j]``, success on task j after the phase of task i, in a panel for each run.

    Cells give percent; tasks that have not been presented stay white. A task that is forgotten
    fades down its column.

    Args:
        matrices: Success in [0, 1] by title, ``[T, T]``; NaN for tasks that were not tested.
        tasks: Names of the tasks, in the order of their presentation.

    Raises:
        ValueError: If there are no matrices, or one does not have a row and a column per task.
    """
    n_tasks = len(tasks)
    found = {title: np.asarray(matrix, float) for title, matrix in matrices.items()}
    wrong = [list(matrix.shape) for matrix in found.values() if matrix.shape != (n_tasks, n_tasks)]
    if wrong or not found:
        raise ValueError(
            f"matrices must be [{n_tasks}, {n_tasks}], a row and a column per task, "
            f"not {wrong[0] if wrong else 'none'}"
        )
    n_columns = min(_COLUMNS, len(found))
    n_rows = math.ceil(len(found) / n_columns)
    side = 0.31 * n_tasks  # inches
    # Titles of panels of few tasks are longer than these; a letter is about 0.08 wide.
    width = max(side, 0.08 * max(map(len, found)))
    figure = Figure(figsize=(width * n_columns + 2.9, (side + 0.45) * n_rows + 0.5))
    figure.set_layout_engine("constrained", w_pad=0.08, h_pad=0.08)
    panels = figure.subplots(n_rows, n_columns, squeeze=False).flat
    for number, (title, matrix) in enumerate(found.items()):
        panel = panels[number]
        image = _draw_matrix(panel, matrix)
        panel.set_title(title, fontsize=9)
        _label_tasks(panel, tasks, names=number % n_columns == 0)
    for panel in panels[len(found) :]:
        panel.remove()
    figure.supxlabel("Success on task", fontsize=9)
    figure.supylabel("After the phase of task", fontsize=9)
    bar = figure.colorbar(image, ax=figure.axes, shrink=0.8, aspect=30, pad=0.02)
    bar.ax.tick_params(labelsize=8)
    bar.set_label("Success rate", fontsize=9)
    return figure


def _draw_matrix(panel: Axes, matrix: NDArray) -> AxesImage:
    image = panel.imshow(matrix, cmap=_COLOR_MAP, vmin=0, vmax=1)
    for (row, column), success in np.ndenumerate(matrix):
        if np.isfinite(success):
            color = "w" if success < _WHITE_BELOW else "k"
            text = f"{100 * success:.0f}"
            panel.text(column, row, text, ha="center", va="center", fontsize=7, color=color)
    return image


def _label_tasks(panel: Axes, tasks: Sequence[str], *, names: bool) -> None:
    """Label the axes with the numbers of the tasks, and the rows with their names if asked."""
    numbers = [str(number) for number in range(1, len(tasks) + 1)]
    rows = [f"{number}: {readable(task)}" for number, task in zip(numbers, tasks, strict=True)]
    panel.set_xticks(range(len(tasks)), numbers)
    panel.set_yticks(range(len(tasks)), rows if names else numbers)
    panel.tick_params(labelsize=8, length=0)
    panel.spines[:].set_visible(False)
