"""The report against runs whose success is made up by hand."""

import json
import re

import numpy as np
import pytest

from benchmarks import comparison, report
from suites import nico

TASKS = nico.ALL_TASKS
HEAD = "algorithm,seed,episode,env_steps,task,success,return,steps\n"


def write_run(folder, name, level, *, episodes=40, starts=(0, 0, 0), seeds=(0, 1, 2)):
    """A run that succeeds in `level` of ten tests, in the last fifth; half as often before."""
    directory = folder / name
    directory.mkdir(parents=True)
    config = {"name": name.split("-", 1)[1], "seeds": list(seeds), "task_starts": list(starts)}
    config |= {"episodes": episodes, "eval_every": 2}
    (directory / "config.json").write_text(json.dumps(config))
    (directory / "summary.json").write_text(json.dumps({"commit": "abc", "command": "python x"}))
    lines = []
    for seed in seeds:
        for episode in range(2, episodes + 1, 2):
            for task, start in zip(TASKS, starts, strict=True):
                if episode > start:
                    won = level if episode > 0.8 * episodes else level // 2
                    for test in range(10):
                        lines.append(
                            f"{config['name']},{seed},{episode},9,{task},{int(test < won)},0,5"
                        )
    (directory / "eval.csv").write_text(HEAD + "\n".join(lines) + "\n")
    return directory


def write_runs(folder):
    """Everything that the figures need but one run; BGPO is best."""
    levels = {"bgpo": 9, "maml": 5, "dist-nll": 7, "oracle": 9, "ddpg": 2}
    for key, level in levels.items():
        write_run(folder, f"concurrent-{key}", level)
    starts = (0, 14, 26)
    for key, level in {**levels, "bgpo": 9, "maml": 2, "dist-nll": 7}.items():
        if key != "oracle":
            write_run(folder, f"continual-{key}", level, starts=starts)
    for key, level in {"gwr": 8, "r_int": 8, "none": 9}.items():
        write_run(folder, f"ablation-{key}", level)
    rng = np.random.default_rng(0)
    nodes = ["task," + ",".join(f"w{i}" for i in range(4))]
    nodes += [f"{i % 3}," + ",".join(map(str, rng.random(4))) for i in range(9)]
    (folder / "concurrent-bgpo" / "gwr.csv").write_text("\n".join(nodes) + "\n")
    return folder


@pytest.fixture
def runs(tmp_path):
    return write_runs(tmp_path)


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """The report on those runs, made once: only to be read."""
    folder = write_runs(tmp_path_factory.mktemp("runs"))
    report.main(report.Arguments(folder))
    return folder


def rows_of(text, title):
    """The table below a title, as lists of cells, by the first cell."""
    section = text.split(f"## {title}")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {row[0]: row[1:] for row in table[2:]}


def test_tables_hold_what_the_runs_did(reported):
    late = rows_of((reported / "tables.md").read_text(), "Fig. 6")
    assert late["BGPO"][:5] == ["90.0 [90, 90]", "90.0", "90", "90", "90"]
    assert late["MAML"][:5] == ["50.0 [50, 50]", "50.0", "50", "50", "50"]
    # Four tests at 90 % end at 34, 36, ..., 40: the mean of three is there at 38.
    assert late["BGPO"][6] == "38"
    assert late["MAML"][6] == "not reached"
    # From 0 to 0.4 in 2 episodes, 0.4 to episode 32, to 0.9 at 34, 0.9 to 40.
    area = (2 * 0.2 + 30 * 0.4 + 2 * 0.65 + 6 * 0.9) / 40
    assert late["BGPO"][5].startswith(f"{100 * area:.1f} [")
    assert list(late) == list(comparison.ALGORITHMS.values())


def test_how_far_the_tasks_lie_apart_in_behavior_space(reported):
    nodes = np.loadtxt(reported / "concurrent-bgpo" / "gwr.csv", delimiter=",", skiprows=1)
    means = [nodes[nodes[:, 0] == task, 1:].mean(0) for task in range(3)]
    table = rows_of((reported / "tables.md").read_text(), "Fig. 7")
    assert table["task 1"][0] == table["task 3"][2] == "0.00"
    assert table["task 3"][1] == table["task 2"][2] == f"{np.linalg.norm(means[1] - means[2]):.2f}"


def test_claims_are_judged_by_their_intervals(reported):
    text = (reported / "tables.md").read_text().split("## The paper's claims")[1]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    found = {(row[0], row[1]): row[2:] for row in rows if len(row) == 4}
    above = found["BGPO above MAML, concurrent", "last 10 %"]
    assert above == ["+40.0 [+40, +40]", "reproduced"]
    assert found["BGPO above Dist-NLL, continual", "area"][1] == "reproduced"
    gap = "the gap to {} is larger in the continual setting"
    assert found[gap.format("MAML"), "last 10 %"] == ["+30.0 [+30, +30]", "reproduced"]
    assert found[gap.format("Dist-NLL"), "last 10 %"] == ["+0.0 [+0, +0]", "not decided"]
    assert found["GWR-B + r_int converges faster than GWR-B", "area"][1] == "reproduced"
    assert found["GWR-B converges faster than r_int", "area"][1] == "not decided"
    assert found["r_int converges faster than none", "area"][1] == "the opposite"
    assert found["GWR-B + r_int converges faster than none", "area"][1] == "not decided"


def test_a_claim_may_turn_out_the_other_way(runs):
    for name in ("concurrent-bgpo", "concurrent-maml"):
        for path in (runs / name).iterdir():
            path.unlink()
        (runs / name).rmdir()
    write_run(runs, "concurrent-bgpo", 4)
    write_run(runs, "concurrent-maml", 8)
    groups = {
        key: comparison.read_group(runs, group)[0] for key, group in comparison.GROUPS.items()
    }
    table = comparison.claims(groups, comparison.Statistics())
    assert [row[3] for row in table if row[0] == "BGPO above MAML, concurrent"] == 2 * [
        "the opposite"
    ]


def test_a_missing_run_is_listed_and_not_made_up(reported, runs):
    text, page = (reported / "tables.md").read_text(), (reported / "report.html").read_text()
    note = "DDPG, told the label: missing (continual-oracle/eval.csv is not there, or empty)"
    assert text.count(note) == page.count(note) == 1
    assert "DDPG, told the label" not in rows_of(text, "Fig. 8")

    path = runs / "ablation-r_int" / "eval.csv"
    path.write_text(HEAD)  # begun, not yet tested
    read = {key: comparison.read_group(runs, group) for key, group in comparison.GROUPS.items()}
    groups, notes = {key: found for key, (found, _) in read.items()}, read["ablation"][1]
    assert notes == ["r_int: missing (ablation-r_int/eval.csv is not there, or empty)"]
    table = comparison.claims(groups, comparison.Statistics())
    missing = [row[0] for row in table if row[3] == "a run is missing"]
    assert missing == ["GWR-B converges faster than r_int", "r_int converges faster than none"]


def test_a_longer_run_is_cut_and_an_unfinished_one_is_told(runs):
    before = comparison.read_group(runs, comparison.GROUPS["concurrent"])[0]["concurrent-ddpg"]
    directory = runs / "concurrent-maml"
    lines = (directory / "eval.csv").read_text().splitlines()
    kept = [line for line in lines[1:] if int(line.split(",")[2]) <= 30]
    (directory / "eval.csv").write_text("\n".join([lines[0], *kept]) + "\n")
    found, notes = comparison.read_group(runs, comparison.GROUPS["concurrent"])
    assert {int(run.curves.episodes[-1]) for run in found.values()} == {30}
    assert "MAML: not finished, 30 of 40 episodes" in notes
    assert "BGPO: cut at 30 of 40 episodes" in notes
    cut = found["concurrent-ddpg"].curves.success
    assert cut.tolist() == before.curves.success[:, :15].tolist()


@pytest.mark.parametrize(("what", "value"), [("seeds", [0, 1]), ("task_starts", [0, 2, 4])])
def test_runs_on_other_terms_are_refused(runs, what, value):
    path = runs / "concurrent-ddpg" / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), what: value}))
    with pytest.raises(ValueError, match=f"concurrent-ddpg has {what} .*on equal terms"):
        report.main(report.Arguments(runs))


def test_forgetting_and_transfer_by_hand(runs):
    table = comparison.continual_table(
        *(
            comparison.read_group(runs, comparison.GROUPS[key])[0]
            for key in ("continual", "concurrent")
        )
    )
    cells = {row[0]: row[1:] for row in table}
    # Tasks 1 and 2 are at 40 % at the end of their phase and at 90 % in the end.
    assert cells["BGPO"][0] == "-50.0 ± 0.0"
    assert cells["BGPO"][2] == "50.0 ± 0.0"
    assert cells["BGPO"][1] == "0.0 ± 0.0"
    # Over its first 26 episodes, task 2 has four tests at 90 % that it does not have beside others.
    rise = (2 * 0.2 + 16 * 0.4 + 2 * 0.65 + 6 * 0.9) / 26, (2 * 0.2 + 24 * 0.4) / 26
    third = (2 * 0.2 + 4 * 0.4 + 2 * 0.65 + 6 * 0.9) / 14, (2 * 0.2 + 12 * 0.4) / 14
    gain = np.mean([(now - then) / (1 - then) for now, then in (rise, third)])
    assert cells["BGPO"][3] == f"{100 * gain:.1f} ± 0.0"


def test_the_page_needs_nothing_else(reported):
    page = (reported / "report.html").read_text()
    for figure in ("fig6", "fig7", "fig8", "fig9"):
        assert (reported / f"{figure}.png").read_bytes().startswith(b"\x89PNG")
    assert page.count("data:image/png;base64,") == 4
    assert not re.findall(r"(?:src|href)=[\"'](?!data:)", page)
    assert "<script" not in page
    assert "&quot;task_starts&quot;" in page


def test_the_same_files_make_the_same_report(reported, tmp_path, capsys):
    report.main(report.Arguments(reported, out=tmp_path))
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["fig6.png", "fig7.png", "fig8.png", "fig9.png", "report.html", "tables.md"]
    for name in names:
        assert (tmp_path / name).read_bytes() == (reported / name).read_bytes()
    assert capsys.readouterr().out.strip() == (tmp_path / "tables.md").read_text().strip()


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(ValueError, match="is no directory"):
        report.main(report.Arguments(tmp_path / "none"))
    with pytest.raises(ValueError, match="holds none of the runs"):
        report.main(report.Arguments(tmp_path))
