"""Which runs are compared, and which are not."""

from dataclasses import replace

import pytest

from bgpo_trl.analysis.comparison import check_conditions, joined, read_settings, reference_of
from bgpo_trl.runs.results import read_run, run_directories
from tests.analysis.runs import HEAD, TASKS, write_run
from tests.helpers import edit

SEQUENCE = (0, 14, 26)


def settings_in(folder):
    settings, left_out = read_settings(run_directories([folder]))
    return {setting.title: setting for setting in settings}, left_out


def test_runs_are_sorted_by_tasks_and_their_presentation(tmp_path):
    eight = tuple("abcdefgh")
    for name in ("oracle", "mine", "bgpo"):
        write_run(tmp_path, name, 5, starts=SEQUENCE)
    write_run(tmp_path, "bgpo", 5)
    write_run(tmp_path, "bgpo", 5, tasks=eight, starts=range(0, 40, 5), directory="a")
    write_run(tmp_path, "bgpo", 5, tasks=eight[::-1], starts=range(0, 40, 5), directory="b")
    write_run(tmp_path, "bgpo", 5, starts=(0, 0, 20), directory="c")
    write_run(tmp_path, "bgpo", 5, starts=SEQUENCE, directory="0", schedule="sequential")
    (tmp_path / "no-run").mkdir()
    found, left_out = settings_in(tmp_path)
    assert {title: setting.slug for title, setting in found.items()} == {
        "3 tasks, one after the other, sequential": "continual-3-sequential",
        "3 tasks, one after the other": "continual-3",
        "3 tasks, from episodes 0, 0, 20": "staggered-3",
        "3 tasks, all from the start": "concurrent-3",
        "8 tasks, one after the other": "continual-8",
        "8 tasks, one after the other, in reverse": "continual-8-in-reverse",
    }
    three = found["3 tasks, one after the other"]
    assert list(three.runs) == ["BGPO", "DDPG, told the label", "mine"]
    assert three.in_sequence and not three.from_start and not left_out
    reference = reference_of(three, found.values())
    assert reference is found["3 tasks, all from the start"]
    assert reference_of(found["8 tasks, one after the other"], found.values()) is None


def test_changed_hyperparameters_are_part_of_a_name(tmp_path):
    """The plain run comes first, though its directory does not."""
    changed = write_run(tmp_path, "bgpo", 8, directory="a")
    edit(changed / "summary.json", changed={"beta": 0.2, "rl.name": "td3"})
    plain = write_run(tmp_path, "bgpo", 8, directory="b")
    (setting,) = settings_in(tmp_path)[0].values()
    assert [(name, run.directory) for name, run in setting.runs.items()] == [
        ("BGPO", plain),
        ("BGPO, beta 0.2, rl.name td3", changed),
    ]
    found = setting.runs["BGPO"]
    assert setting.find(found) is found
    (alone,) = settings_in(changed)[0].values()
    assert alone.find(found) is None
    other = write_run(tmp_path, "bgpo", 8, directory="c", algorithm={"max_steps": 50, "beta": 0.9})
    assert setting.find(read_run(other)) is None  # whether or not its summary tells


@pytest.mark.parametrize(
    ("what", "ours", "theirs"),
    [
        ("encoders", "eeeeeeeeeeee...", "f" * 12),
        ("gravity", 9.81, 3.7),  # whatever else a version stores of the world
        ("logged", None, "one"),  # which runs without logged episodes do not store
    ],
)
def test_runs_under_other_conditions_are_refused(tmp_path, refused, what, ours, theirs):
    more = {"spread": 1.0, "gravity": 9.81, "bank": "b" * 64}
    write_run(tmp_path, "bgpo", 5, starts=SEQUENCE, **more)
    other = write_run(tmp_path, "oracle", 5, starts=SEQUENCE, **more)
    edit(other / "config.json", **{what: theirs})
    refused(lambda: settings_in(tmp_path), f"differ in {what} ({ours} and {theirs})", "only runs")


def test_all_runs_are_compared_with_each_other(tmp_path, refused):
    """Also those after a run that does not state the condition."""
    write_run(tmp_path, "bgpo", 5)
    write_run(tmp_path, "oracle", 5, spread=1.0)
    write_run(tmp_path, "maml", 5, spread=0.25)
    refused(lambda: settings_in(tmp_path), "differ in spread (", "only runs")


@pytest.mark.parametrize(
    ("settings", "changed", "number"),
    [
        ({}, {}, 1),
        ({"algorithm": {"max_steps": 50, "pace": 1.0}}, {}, 1),  # a setting that came later
        ({"algorithm": {"max_steps": 50, "pace": 1.5}}, {"pace": 1.5}, 2),
        ({"algorithm": {"max_steps": 30}}, {}, 2),
        ({"demonstrations": 30}, {}, 2),
    ],
)
def test_runs_that_differ_in_their_seeds_alone_are_joined(tmp_path, settings, changed, number):
    first = read_run(write_run(tmp_path, "bgpo", [5]))
    config = {**first.config, "seeds": [1], **settings}
    other = replace(first, config=config, summary={**first.summary, "changed": changed})
    for runs in ([first, other], [other, first]):
        found = joined(runs)
        assert len(found) == number
        assert sorted(seed for run in found for seed in run.seeds) == [0, 1]
        assert found[0].changed == runs[0].changed


def test_seeds_and_algorithms_are_not_conditions(tmp_path):
    first = write_run(tmp_path, "bgpo", [5, 5], checkpoint_minutes=10)
    second = write_run(tmp_path, "oracle", [5, 5, 5], checkpoint_minutes=5)
    edit(second / "config.json", algorithm={"max_steps": 50, "beta": 0}, world="a", encoders="x")
    config = (first / "config.json").read_text()
    (first / "config.json").write_text(config.replace('"encoders"', '"colour"'))
    check_conditions(read_run(second), read_run(first))
    edit(second / "config.json", algorithm={"max_steps": 30})
    with pytest.raises(ValueError, match=r"differ in max_steps \(30 and 50\): only runs"):
        check_conditions(read_run(second), read_run(first))


def test_the_reference_of_transfer_is_checked_too(tmp_path):
    """But not the digest of its bank, which depends on the order of tasks, if that is another."""
    write_run(tmp_path, "bgpo", 5, starts=SEQUENCE, bank="b" * 64)
    other = write_run(tmp_path, "bgpo", 5, tasks=TASKS[::-1], bank="c" * 64, episodes=50)

    def check(**changes):
        edit(other / "config.json", **changes)
        continual, concurrent = settings_in(tmp_path)[0].values()
        assert reference_of(continual, (continual, concurrent)) is concurrent

    check()
    with pytest.raises(ValueError, match=r"differ in held_out \(validation and test\): only runs"):
        check(held_out="test")
    with pytest.raises(ValueError, match="differ in bank"):
        check(held_out="validation", tasks=TASKS)


def test_unfinished_runs_are_left_out(tmp_path):
    write_run(tmp_path, "oracle", 5)
    path = write_run(tmp_path, "bgpo", 5)
    for episodes, unfinished in ((40, ""), (41, ""), (42, "has tests until episode 40 of 42")):
        edit(path / "config.json", episodes=episodes)
        assert read_run(path).unfinished == unfinished
    found, left_out = settings_in(tmp_path)
    assert [list(setting.runs) for setting in found.values()] == [["DDPG, told the label"]]
    assert left_out == f"{path} has tests until episode 40 of 42: let them finish"
    waiting = [path, write_run(tmp_path, "maml", 5), write_run(tmp_path, "ddpg", 5)]
    edit(waiting[1] / "config.json", episodes=42)
    (waiting[2] / "eval.csv").unlink()
    found, left_out = settings_in(tmp_path)
    assert len(found) == 1 and left_out.isprintable()
    assert all(str(run) in left_out for run in waiting)
    edit(path / "config.json", episodes=40)
    edit(path / "summary.json", episodes=30)  # continued, and its summary not yet written
    assert read_run(path).unfinished == "is being extended"
    with pytest.raises(ValueError, match="is being extended: let them finish"):
        read_settings([path])
    (path / "checkpoint").mkdir()
    (path / "summary.json").unlink()  # interrupted in its last tests
    assert read_run(path).unfinished.startswith("has no summary")


def test_folders_without_runs_are_refused(tmp_path):
    with pytest.raises(ValueError, match="none is not a directory: name a run"):
        run_directories([tmp_path / "none"])
    with pytest.raises(ValueError, match="holds no run: name a run, or a folder of runs"):
        run_directories([tmp_path])
    path = write_run(tmp_path, "bgpo", 5)
    assert run_directories([path]) == run_directories([tmp_path]) == [path]
    (path / "eval.csv").write_text(HEAD)  # begun, not yet tested
    with pytest.raises(ValueError, match="holds no test episode"):
        read_settings([path])
    write_run(tmp_path, "oracle", 5)
    found, left_out = settings_in(tmp_path)
    assert len(found) == 1 and left_out.startswith(f"{path} holds no test episode")
