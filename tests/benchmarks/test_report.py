"""The report against runs whose success is made up by hand."""

import itertools
import json
import re
import shutil

import numpy as np
import pytest

from benchmarks import report
from bgpo_trl.algorithms import ABLATIONS, ALGORITHMS
from bgpo_trl.analysis import claims, comparison, intervals, paper_runs
from bgpo_trl.analysis import tables as report_tables
from bgpo_trl.analysis.transfer import forward_transfer
from suites import nico

TASKS = nico.PAPER_TASKS
FIGURES = [f"fig{n}.png" for n in ("6", "6-without", "6-published", "7", "8", "8-without")]
FIGURES += ["fig9.png", "fig9-added.png"]  # of the continual ablation, there is no run
HEAD = "algorithm,seed,episode,env_steps,task,success,return,steps\n"


def write_run(folder, name, level, *, episodes=40, starts=(0, 0, 0), seeds=(0, 1, 2), tasks=TASKS):
    """A run that succeeds in `level` of ten tests, in the last fifth; half as often before."""
    directory = folder / name
    directory.mkdir(parents=True)
    config = {"name": name.split("-", 1)[1], "seeds": list(seeds), "task_starts": list(starts)}
    config |= {} if tasks == TASKS else {"tasks": list(tasks)}  # those of earlier versions
    config |= {"episodes": episodes, "eval_every": 2, "eval_episodes": 10}
    config |= {"held_out": "validation", "algorithm": {"max_steps": 50}}
    (directory / "config.json").write_text(json.dumps(config))
    (directory / "summary.json").write_text(json.dumps({"commit": "abc", "command": "python x"}))
    lines = []
    for seed in seeds:
        for episode in range(2, episodes + 1, 2):
            for task, start in zip(tasks, starts, strict=True):
                if episode > start:
                    won = level if episode > 0.8 * episodes else level // 2
                    for test in range(10):
                        lines.append(
                            f"{config['name']},{seed},{episode},9,{task},{int(test < won)},0,5"
                        )
    (directory / "eval.csv").write_text(HEAD + "\n".join(lines) + "\n")
    return directory


def write_runs(folder):
    """Runs of every kind, but not all that the figures need; BGPO is best."""
    levels = {"bgpo": 9, "bgpo-single": 9, "maml": 5, "maml-demonstrations": 5, "dist-nll": 7}
    levels |= {"oracle": 9, "ddpg": 2}
    for key, level in {**levels, "bgpo-paper": 4, "maml-paper": 8}.items():
        write_run(folder, f"concurrent-{key}", level)
    starts = (0, 14, 26)
    for key, level in {**levels, "maml": 2, "maml-demonstrations": 2}.items():
        if key != "oracle":
            write_run(folder, f"continual-{key}", level, starts=starts)
    for key, level in {"gwr": 8, "r_int": 8, "none": 9, "even-replay": 9}.items():
        write_run(folder, f"ablation-{key}", level)
    rng = np.random.default_rng(0)
    nodes = ["task,group," + ",".join(f"w{i}" for i in range(4))]
    nodes += [f"{i % 3},{i % 2}," + ",".join(map(str, rng.random(4))) for i in range(9)]
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
    missing = ["BGPO without demonstrations", "Dist-NLL + demonstrations"]
    assert list(late) == [n for n in paper_runs.ALGORITHMS.values() if n not in missing]
    published = rows_of((reported / "tables.md").read_text(), "Fig. 6 as published")
    assert {name: row[1] for name, row in published.items()} == {
        "BGPO as published": "40.0",
        "MAML as published": "80.0",
    }


def test_how_far_the_tasks_lie_apart_in_behavior_space(reported):
    nodes = np.loadtxt(reported / "concurrent-bgpo" / "gwr.csv", delimiter=",", skiprows=1)
    means = [nodes[nodes[:, 0] == task, 2:].mean(0) for task in range(3)]
    table = rows_of((reported / "tables.md").read_text(), "Fig. 7")
    assert table["task 1"][0] == table["task 3"][2] == "0.00"
    assert table["task 3"][1] == table["task 2"][2] == f"{np.linalg.norm(means[1] - means[2]):.2f}"


def claims_of(runs, table=claims.claims):
    """The rows of the claims, by all but the last two cells."""
    groups = {
        key: comparison.read_group(runs, group)[0] for key, group in paper_runs.GROUPS.items()
    }
    return {tuple(row[:-2]): row[-2:] for row in table(groups, intervals.Statistics())}


def test_claims_are_judged_by_their_intervals(reported):
    found = claims_of(reported)
    late = "last 10 %"
    shown = "BGPO against MAML + demonstrations"
    assert found["BGPO above MAML, concurrent", shown, late] == ["+40.0 [+40, +40]", "reproduced"]
    single = "BGPO, one policy against {}"
    above = found["BGPO above Dist-NLL, continual", single.format("Dist-NLL"), "area"]
    assert above[1] == "reproduced"
    published = "BGPO as published against MAML as published"
    assert found["BGPO above MAML, concurrent", published, late][1] == "the opposite"
    gap = "the gap to {} is larger in the continual setting"
    assert found[gap.format("MAML"), shown, late] == ["+30.0 [+30, +30]", "reproduced"]
    level = found[gap.format("Dist-NLL"), single.format("Dist-NLL"), late]
    assert level == ["+0.0 [+0, +0]", "level"]
    variants = ("variants of BGPO, one policy", "area")
    assert found["GWR-B + r_int converges faster than GWR-B", *variants][1] == "reproduced"
    assert found["GWR-B converges faster than r_int", *variants][1] == "level"
    assert found["r_int converges faster than none", *variants][1] == "the opposite"
    assert found["GWR-B + r_int converges faster than none", *variants][1] == "level"


def test_each_bgpo_is_tested_against_baselines_on_its_terms(reported):
    found = claims_of(reported)
    tested = {claim[1] for claim in found if claim[0] == "BGPO above Dist-NLL, continual"}
    assert tested == {
        "BGPO against Dist-NLL + demonstrations",
        "BGPO without demonstrations against Dist-NLL",
        "BGPO, one policy against Dist-NLL",
        "BGPO as published against Dist-NLL as published",
    }
    missing = {claim[:2]: row[1] for claim, row in found.items() if not row[0]}
    above = ("BGPO above Dist-NLL, concurrent", "BGPO against Dist-NLL + demonstrations")
    assert missing[above] == "missing: concurrent-dist-nll-demonstrations"
    gap = ("the gap to MAML is larger in the continual setting", "BGPO as published against MAML ")
    assert missing[gap[0], gap[1] + "as published"] == (
        "missing: continual-bgpo-paper, continual-maml-paper"
    )


def test_what_is_added_is_compared_step_by_step(reported):
    found = claims_of(reported, claims.additions)
    step = ("+ even replay", "GWR-B + r_int", "concurrent", "area")
    assert found[step] == ["+0.0 [+0, +0]", "level"]
    assert found["+ all three", "GWR-B + r_int", "continual", "last 10 %"][1] == "level"
    unknown = found["+ even replay + experts", "+ even replay", "continual", "area"]
    assert unknown[1] == "missing: continual-bgpo-experts, ablation-continual-even-replay"


def test_variants_that_are_algorithms_are_the_same_in_all():
    for variant, algorithm in paper_runs.SAME.items():
        assert ABLATIONS[variant].config == ALGORITHMS[algorithm].config
    variants = {*paper_runs.PUBLISHED_VARIANTS, *paper_runs.ADDITIONS}
    assert variants == set(ABLATIONS)
    assert {*paper_runs.ALGORITHMS, *paper_runs.PUBLISHED} == set(ALGORITHMS)


def test_a_claim_may_turn_out_the_other_way(runs):
    for name in ("concurrent-bgpo", "concurrent-maml-demonstrations"):
        shutil.rmtree(runs / name)
    write_run(runs, "concurrent-bgpo", 4)
    write_run(runs, "concurrent-maml-demonstrations", 8)
    shown = "BGPO against MAML + demonstrations"
    found = claims_of(runs)
    for what in ("last 10 %", "area"):
        assert found["BGPO above MAML, concurrent", shown, what][1] == "the opposite"


def test_a_missing_run_is_listed_and_not_made_up(reported, runs):
    text, page = (reported / "tables.md").read_text(), (reported / "report.html").read_text()
    note = "DDPG, told the label: missing (continual-oracle/eval.csv is not there, or empty)"
    assert text.count(note) == page.count(note) == 2  # in the ablation, too
    assert "DDPG, told the label" not in rows_of(text, "Fig. 8")

    assert "- missing: continual-bgpo-paper, continual-maml-paper, continual-dist-nll-paper" in text

    path = runs / "ablation-r_int" / "eval.csv"
    path.write_text(HEAD)  # begun, not yet tested
    read = {key: comparison.read_group(runs, group) for key, group in paper_runs.GROUPS.items()}
    groups, notes = {key: found for key, (found, _) in read.items()}, read["ablation"][1]
    assert "r_int: missing (ablation-r_int/eval.csv is not there, or empty)" in notes
    table = claims.claims(groups, intervals.Statistics())
    missing = [row[0] for row in table if row[4] == "missing: ablation-r_int"]
    assert missing == ["GWR-B converges faster than r_int", "r_int converges faster than none"]


def test_a_longer_run_is_cut_and_an_unfinished_one_is_told(runs):
    before = comparison.read_group(runs, paper_runs.GROUPS["concurrent"])[0]["concurrent-ddpg"]
    directory = runs / "concurrent-maml"
    lines = (directory / "eval.csv").read_text().splitlines()
    kept = [line for line in lines[1:] if int(line.split(",")[2]) <= 30]
    (directory / "eval.csv").write_text("\n".join([lines[0], *kept]) + "\n")
    found, notes = comparison.read_group(runs, paper_runs.GROUPS["concurrent"])
    assert {int(run.curves.episodes[-1]) for run in found.values()} == {30}
    assert "MAML: not finished, 30 of 40 episodes" in notes
    assert "BGPO: cut at 30 of 40 episodes" in notes
    cut = found["concurrent-ddpg"].curves.success
    assert cut.tolist() == before.curves.success[:, :15].tolist()


@pytest.mark.parametrize(
    ("what", "value"),
    [
        ("seeds", [0, 1]),
        ("task_starts", [0, 2, 4]),
        ("held_out", "test"),
        ("eval_episodes", 77),
        ("eval_every", 7),
        ("max_steps", 30),
    ],
)
def test_runs_on_other_terms_are_refused(runs, what, value):
    path = runs / "concurrent-ddpg" / "config.json"
    config = json.loads(path.read_text())
    of_algorithm = {"algorithm": {**config["algorithm"], what: value}}
    change = of_algorithm if what == "max_steps" else {what: value}
    path.write_text(json.dumps({**config, **change}))
    with pytest.raises(ValueError, match=f"concurrent-ddpg has {what} .*on equal terms"):
        report.main(report.Arguments(runs))


def test_forgetting_and_transfer_by_hand(runs):
    continual, concurrent = (
        comparison.read_group(runs, paper_runs.GROUPS[key])[0]
        for key in ("continual", "concurrent")
    )
    statistics = intervals.Statistics()
    head, *rows = report_tables.continual_table(continual, concurrent, statistics)
    cells = {row[0]: dict(zip(head, row, strict=True)) for row in rows}["BGPO"]
    # Tasks 1 and 2 are at 40 % at the end of their phase and at 90 % in the end.
    assert cells["backward transfer"] == "50.0 [50, 50]"
    assert cells["forgotten since best"] == "0.0 [0, 0]"
    pair = continual["continual-bgpo"], concurrent["concurrent-bgpo"]
    gain, _ = forward_transfer(*pair, statistics)
    assert cells["forward transfer"].startswith(f"{100 * gain:.1f} [")


def write_training(directory, seeds):
    """Writes a train.csv from outcomes by task, one list a seed; tasks take turns."""
    lines = [HEAD.strip()]
    for seed, tasks in enumerate(seeds):
        turns = [
            (task, success)
            for row in itertools.zip_longest(*tasks)
            for task, success in zip(TASKS, row, strict=True)
            if success is not None
        ]
        for episode, (task, success) in enumerate(turns, 1):
            lines.append(f"bgpo,{seed},{episode},9,{task},{success},0,5")
    (directory / "train.csv").write_text("\n".join(lines) + "\n")


def test_how_fast_each_task_is_learned(tmp_path):
    def learned(after):  # half of the last twenty after so many
        return [0] * (after - 10) + [1] * 10

    never = [0] * 30
    directory = write_run(tmp_path, "continual-bgpo", 9, episodes=120, seeds=(0, 1, 2))
    seeds = [[learned(20), learned(30), never], [learned(40), learned(40), learned(30)]]
    write_training(directory, [*seeds, [never, learned(20), learned(20)]])
    write_run(tmp_path, "continual-ddpg", 2, episodes=120, seeds=(0, 1, 2))
    found, _ = comparison.read_group(tmp_path, paper_runs.GROUPS["continual"])
    head, bgpo, ddpg = report_tables.speed_table(found)
    assert head == ["", *(f"task {i}" for i in (1, 2, 3)), "task 2 : task 1", "task 3 : task 1"]
    one = "(1 of 3 seeds never)"
    # The first two seeds say how the tasks compare: 1.5 and 1; never and 0.75.
    ratios = ["1.25 (2 of 3 seeds)", "not reached (2 of 3 seeds)"]
    assert bgpo == ["BGPO", f"40 {one}", "30", f"30 {one}", *ratios]
    assert ddpg == ["DDPG, told nothing", *["no train.csv"] * 3, "", ""]
    # Of the third seed's 20 episodes of tasks 2 and 3 the last are its 59th and 60th.
    episodes = report_tables.own_episodes(directory / "train.csv", TASKS, last=59)
    assert episodes[2].tolist() == [np.inf, 20, np.inf]


def test_groups_and_inference_by_seed(tmp_path):
    final = "seed,demonstrations,task,episodes,success,task_inference\n"
    for name, told in {
        "continual-bgpo": {"nodes": [90, 80], "groups": [3, 4], "group_purity": [1.0, 0.985]},
        "continual-bgpo-single": {"nodes": [70, 60], "groups": None},
        "continual-maml": {"nodes": None, "groups": None},
    }.items():
        directory = write_run(tmp_path, name, 9, seeds=(0, 1))
        (directory / "summary.json").write_text(json.dumps(told))
        shares = {0: (1.0, 0.9, 1.0), 1: (1.0, 1.0, 0.97)}
        cells = [
            f"{seed},{kind},{task},20,0.5,{share if kind == 'held-out' else 0.1}\n"
            for kind in ("seen", "held-out")
            for seed, of_seed in shares.items()
            for task, share in zip(TASKS, of_seed, strict=True)
        ]
        (directory / "final.csv").write_text(final + "".join(cells))
    found, _ = comparison.read_group(tmp_path, paper_runs.GROUPS["continual"])
    _, *rows = report_tables.groups_table(found.values())
    inferred = ["97.83", "96.7 99"]  # 2.9 and 2.97 of 3
    assert rows == [
        ["continual-bgpo", "3 4", "100 98.5", *inferred, "90 80"],
        ["continual-bgpo-single", "one for all", "", *inferred, "70 60"],
    ]
    assert report_tables.groups_table([found["continual-maml"]]) == []


def test_the_page_needs_nothing_else(reported):
    page = (reported / "report.html").read_text()
    for figure in FIGURES:
        assert (reported / figure).read_bytes().startswith(b"\x89PNG")
    assert page.count("data:image/png;base64,") == len(FIGURES)
    assert not re.findall(r"(?:src|href)=[\"'](?!data:)", page)
    assert "<script" not in page
    assert "&quot;task_starts&quot;" in page


def test_the_same_files_make_the_same_report(reported, tmp_path, capsys):
    report.main(report.Arguments(reported, out=tmp_path))
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == sorted([*FIGURES, "report.html", "tables.md"])
    for name in names:
        assert (tmp_path / name).read_bytes() == (reported / name).read_bytes()
    assert capsys.readouterr().out.strip() == (tmp_path / "tables.md").read_text().strip()


@pytest.mark.parametrize("tasks", [("juggle",), (*TASKS, "juggle")])
def test_runs_of_other_tasks_are_reported(tmp_path, tasks):
    starts = tuple(10 * position for position in range(len(tasks)))
    for name, level in {"bgpo": 9, "ddpg": 2}.items():
        write_run(tmp_path, f"concurrent-{name}", level, tasks=tasks, starts=(0,) * len(tasks))
        write_run(tmp_path, f"continual-{name}", level, tasks=tasks, starts=starts)
    (tmp_path / "concurrent-bgpo" / "gwr.csv").write_text(
        f"task,w0,w1\n0,1,2\n{len(tasks) - 1},2,5\n-1,0,0\n"
    )
    report.main(report.Arguments(tmp_path))
    text = (tmp_path / "tables.md").read_text()
    for title in ("Fig. 6", "Fig. 8"):
        found = rows_of(text, title)
        assert found["BGPO"][1 : 2 + len(tasks)] == ["90.0", *["90"] * len(tasks)]
        assert found["DDPG, told nothing"][1 : 2 + len(tasks)] == ["20.0", *["20"] * len(tasks)]
    assert "nan" not in text
    assert (tmp_path / "fig7.png").exists()


def test_what_trainer_alone_writes_is_reported(run_of, tmp_path):
    """Without what final tests and a command line leave."""
    folder = tmp_path / "reported"
    shutil.copytree(run_of("bgpo"), folder / "continual-bgpo")
    assert not {"final.csv", "summary.json"} & {path.name for path in folder.rglob("*")}
    report.main(report.Arguments(folder))
    text = (folder / "tables.md").read_text()
    (success,) = rows_of(text, "Fig. 8")["BGPO"][1:2]
    assert 0 <= float(success) <= 100
    assert "nan" not in text


def test_runs_of_different_tasks_are_not_compared(tmp_path):
    write_run(tmp_path, "concurrent-bgpo", 9)
    write_run(tmp_path, "continual-bgpo", 9, tasks=("juggle",), starts=(0,))
    with pytest.raises(ValueError, match="holds runs of different tasks: name a directory for"):
        report.main(report.Arguments(tmp_path))


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(ValueError, match="is not a directory"):
        report.main(report.Arguments(tmp_path / "none"))
    with pytest.raises(ValueError, match="holds none of the runs"):
        report.main(report.Arguments(tmp_path))
