"""The notebook runs from top to bottom, with few episodes of training."""

import re
from pathlib import Path

import nbformat
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[1] / "examples" / "tour.ipynb"
SHORTER = {
    'EPISODES = "push_green_to_glass", 240': 'EPISODES = "push_green_to_glass", 2',
    "eval_episodes=20": "eval_episodes=1",
    'ROOT / "runs" / "tour"': 'Path("RUNS")',
}


def test_it_prints_what_it_says_and_shows_figures_and_a_film(tmp_path):
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    assert all(not cell.outputs for cell in notebook.cells if cell.cell_type == "code")
    for cell in notebook.cells:
        for shown, tested in SHORTER.items():
            cell.source = cell.source.replace(shown, tested.replace("RUNS", str(tmp_path)))
    folder = {"metadata": {"path": str(NOTEBOOK.parent)}}
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources=folder).execute()
    assert (tmp_path / "eval.csv").exists()

    outputs = [out for cell in notebook.cells for out in cell.get("outputs", ())]
    text = "".join(output.text for output in outputs if output.get("name") == "stdout")
    for task in ("grasp_glass", "push_green_to_glass", "push_green_to_white"):
        assert f"{task}: the nearest demonstration of the bank is one of {task}\n" in text
    n_groups = int(text.split(" groups, purity on held-out demonstrations 100%\n")[0].split()[-1])
    assert 6 <= n_groups <= 8  # three tasks on either side, and at most two more
    assert "after 2 episodes: " in text
    assert "Recognition(node=" in text
    assert text.count("success after ") == 3
    kinds = [kind for output in outputs for kind in output.get("data", {}) if "image" in kind]
    assert kinds == ["image/png"] * 2 + ["image/gif", "image/png"]
    assert re.search(r"^after 300 demonstrations: \d+ nodes$", text, re.MULTILINE)
