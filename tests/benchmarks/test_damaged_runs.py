"""Folders of runs that are wrong or not all there: a line each, by whatever reads them."""

import json
import re
import shutil
import warnings

import looking
import one_shot
import pytest
import report

from bgpo_trl.experiments.watch import WatchArguments, watch
from bgpo_trl.figures.of_run import draw_growth
from bgpo_trl.files.checkpoint import save_checkpoint
from bgpo_trl.runs.config_file import read_config
from suites import nico
from tests.folders import contents

TASKS = nico.PAPER_TASKS
RUBBISH = bytes(range(1, 128)) * 3  # which is text, as far as UTF-8 goes
FINAL = "seed,demonstrations,task,episodes,success,task_inference\n"


@pytest.fixture
def run(run_of):
    """A finished run, with what `measure` leaves of it."""
    run = run_of("bgpo")
    rows = [
        f"{seed},{kind},{task},20,0.5,0.25\n"
        for kind in ("seen", "held-out")
        for task in TASKS
        for seed in (3, 8)
    ]
    (run / "final.csv").write_text(FINAL + "".join(rows))
    told = {"commit": "c", "command": "python", "episodes": 10, "nodes": [3, 4]}
    (run / "summary.json").write_text(json.dumps(told))
    return run


def refusal(call):
    """Returns the line in which a call ends."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        with pytest.raises((ValueError, OSError, RuntimeError)) as raised:
            call()
    told = str(raised.value)
    assert told.isprintable() and len(told) < 900, told
    assert re.search(
        r": (let|put|name|resume|remove|use|choose|give make|only|there is no)", told
    ), told
    return told


def edit(name, change):
    def do(run):
        found = json.loads((run / name).read_text())
        change(found)
        (run / name).write_text(json.dumps(found))

    return do


def without(name, key):
    return edit(name, lambda found: found.pop(key))


def having(name, key, value):
    return edit(name, lambda found: found.update({key: value}))


def content(name, data):
    return lambda run: (run / name).write_bytes(data)


def lines(name, keep):
    """Keeps some lines of a file, as a function of their number and text."""

    def do(run):
        told = (run / name).read_text().splitlines(keepends=True)
        kept = [line for number, line in enumerate(told) if number == 0 or keep(number, line)]
        (run / name).write_text("".join(kept))

    return do


def replaced(name, old, new):
    return lambda run: (run / name).write_text((run / name).read_text().replace(old, new, 1))


def of_the_file(name):
    """Kinds of damage that any file may have."""
    return {
        f"{name} missing": lambda run: (run / name).unlink(),
        f"{name} empty": content(name, b""),
        f"{name} rubbish": content(name, RUBBISH),
        f"{name} not even text": content(name, b"\xff\xfe\x00" * 20),
        f"{name} a folder": lambda run: ((run / name).unlink(), (run / name).mkdir()),
    }


def of_the_settings(name):
    return of_the_file(name) | {
        f"{name} a list": content(name, b"[]"),
        f"{name} of something else": content(name, b'{"port": 80}'),
        f"{name} nested": content(name, b"[" * 10**5),
    }


REPORT = {
    **of_the_file("eval.csv"),
    **of_the_file("final.csv"),
    **of_the_settings("config.json"),
    **of_the_settings("summary.json"),
    "no starts": without("config.json", "task_starts"),
    "starts of other tasks": having("config.json", "task_starts", [0, 1]),
    "starts in words": having("config.json", "task_starts", ["now", 1, 2]),
    "tasks by number": having("config.json", "tasks", [1, 2, 3]),
    "no nodes": having("summary.json", "nodes", "many"),
    "training of a longer run": having("config.json", "episodes", 20),
    "table of something else": content("eval.csv", b"date,temperature\nmonday,21\n"),
    "final table of something else": content("final.csv", b"date,temperature\nmonday,21\n"),
    "success that is none": replaced("final.csv", "0.5", "nan"),
    "inference that is none": replaced("final.csv", "0.25", "perhaps"),
    "final row cut short": replaced("final.csv", ",20,0.5,0.25", ""),
    "final tests of one task": lines("final.csv", lambda number, line: TASKS[0] in line),
    "no held-out ones": lines("final.csv", lambda number, line: "seen" in line),
    "a seed without late tests": lines(
        "eval.csv", lambda number, line: not line.startswith("bgpo,8,10")),
    "a task without late tests": lines(
        "eval.csv", lambda number, line: not (",10," in line and TASKS[0] in line)),
    "a test that half succeeds": lambda run: (run / "eval.csv").write_text(
        (run / "eval.csv").read_text() + f"bgpo,3,10,9,{TASKS[0]},inf,0.0,5\n"),
    "a command to the terminal": lambda run: (run / "eval.csv").write_text(
        (run / "eval.csv").read_text().replace(TASKS[0], "\x1b[31mred")),
}  # fmt: skip


# Final tests and a summary come after training, and nothing in the summary is needed.
for _name in ("final.csv missing", "summary.json missing", "summary.json of something else"):
    del REPORT[_name]


@pytest.mark.parametrize("damage", REPORT.values(), ids=REPORT.keys())
def test_a_damaged_run_is_not_reported(run, capsys, damage):
    damage(run)
    before = contents(run)
    refusal(lambda: report.main(report.Arguments((run,))))
    assert capsys.readouterr().out == ""
    assert contents(run) == before


def test_a_run_that_is_all_there_is_reported(run, capsys):
    report.main(report.Arguments((run,)))
    told = capsys.readouterr().out
    assert "nan" not in told
    assert "| one for all |  | 25.00 | 25 25 | 3 4 |" in told
    assert "- `c`, `python`" in told
    assert "| episodes to 80 % |" not in told  # with one task presented, it would be of that alone


def test_what_trainer_alone_writes_is_reported(run, capsys):
    """Without final tests, and without what they and a command line leave."""
    for name in ("final.csv", "summary.json"):
        (run / name).unlink()
    report.main(report.Arguments((run,)))
    told = capsys.readouterr().out
    assert "## GWR-B" not in told and "## Cost" in told
    assert (run / "continual-3.png").exists()


def foreign_checkpoint(state):
    def do(run):
        shutil.rmtree(run / "checkpoint")
        save_checkpoint(run / "checkpoint", state)

    return do


LOADED = {
    **of_the_settings("config.json"),
    "no run at all": lambda run: (shutil.rmtree(run), run.mkdir()),
    "no folder": shutil.rmtree,
    "no checkpoint": lambda run: shutil.rmtree(run / "checkpoint"),
    "a checkpoint of something else": foreign_checkpoint({"step": 3, "loss": {}}),
    "a checkpoint of no algorithm": foreign_checkpoint({"algorithm": 3}),
    "a checkpoint of an empty one": foreign_checkpoint({"algorithm": {}}),
    "half a checkpoint": foreign_checkpoint({"algorithm": {"source": {}, "learner": {}}}),
    "no starts": having("config.json", "task_starts", []),
    "unknown tasks": having("config.json", "tasks", ["juggle", "sleep", "dance"]),
    "unknown settings": having("config.json", "colour", "red"),
    "an unknown algorithm": having("config.json", "name", "ppo"),
    "other encoders": having("config.json", "encoders", "0" * 64),
    "encoders by number": having("config.json", "encoders", 3),
    "ground truth": edit("config.json", lambda found: found["algorithm"].update(state="state")),
}


@pytest.mark.parametrize(
    ("read", "arguments"),
    [
        (watch, WatchArguments),
        (one_shot.main, one_shot.Arguments),
        (looking.main, looking.Arguments),
    ],
    ids=["watch", "one_shot", "looking"],
)
@pytest.mark.parametrize("damage", LOADED.values(), ids=LOADED.keys())
def test_a_damaged_run_is_not_shown_or_tested(run, capsys, damage, read, arguments, tmp_path):
    damage(run)
    refusal(lambda: read(arguments(run, out=tmp_path / "out")))
    assert capsys.readouterr().out == ""
    assert not (tmp_path / "out").exists()


GROWTH = {
    **of_the_file("train.csv"),
    **of_the_file("gwr/episode-000010.safetensors"),
    "no nodes": replaced("train.csv", "num_nodes", "leaves"),
    "another seed": replaced("train.csv", "bgpo,3,", "bgpo,4,"),
    "nodes in words": replaced("train.csv", "bgpo,3,1,", "bgpo,3,1,9,a,0,0.0,5,0.1,many\n"),
    "no episode of a seed": lines("train.csv", lambda number, line: line.startswith("bgpo,3")),
    "no episode": lines("train.csv", lambda number, line: False),
}
del GROWTH["gwr/episode-000010.safetensors missing"]  # There are others.


@pytest.mark.parametrize("damage", GROWTH.values(), ids=GROWTH.keys())
def test_growth_is_not_drawn_from_damaged_files(run, bank, damage, tmp_path):
    config = read_config(run / "config.json")[0]
    damage(run)
    refusal(lambda: draw_growth(run, config, bank, tmp_path / "out"))
    assert not (tmp_path / "out").exists()
