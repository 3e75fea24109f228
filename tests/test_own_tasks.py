"""Tasks from outside the suite: from their registration to their rows in a run's CSV files."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from dm_control import suite
from tensordict import TensorDict

from bgpo_trl.configs import RunConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.envs import NicoEnv
from bgpo_trl.evaluation import evaluate_random_policy
from bgpo_trl.files.tensor_file import load_tensors, save_tensors
from bgpo_trl.training import Trainer
from suites import nico
from suites.nico import moves


class AtOnce(nico.NicoTask):
    """Done with the first step, whatever it is."""

    def succeeded(self, physics):
        return physics.time() > 0


class PushWhiteToGreen(nico.NicoTask):
    def succeeded(self, physics):
        return physics.touching("white_box", "green_box")

    def demonstration(self, physics, random):
        return moves.push(physics, random, "white_box", "green_box")


@pytest.fixture(autouse=True)
def added():
    """Adds two tasks for the time of a test."""
    nico.add_task("at_once", AtOnce)
    nico.add_task("push_white_to_green", PushWhiteToGreen)


def bank_of(*tasks, n=6):
    """Returns a bank in which a demonstration's embedding is its task's and its own number."""
    task = torch.arange(len(tasks)).repeat_interleave(n)
    embedding = torch.stack([task.float(), torch.arange(len(task)).float()], -1)
    return DemonstrationBank(embedding, task, torch.arange(len(task)) % 3 > 0, tasks)


def names_and_embeddings(bank):
    return [
        (bank.tasks[t], *phi) for t, phi in zip(bank.task, bank.embedding.tolist(), strict=True)
    ]


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def play(tmp_path, make_config):
    """Plays a run on ground truth of an algorithm that is told the label."""

    def play(folder, bank, **changes):
        config = replace(make_config("state", "oracle"), **changes)
        Trainer(config, tmp_path / folder, bank=bank, progress=False).run()
        return tmp_path / folder

    return play


def test_an_added_task_is_known_by_name_to_suite_and_environment():
    assert nico.PAPER_TASKS == ("grasp_glass", "push_green_to_glass", "push_green_to_white")
    assert tuple(nico.TASKS)[:3] == nico.PAPER_TASKS
    assert nico.TASKS["at_once"] is AtOnce
    env = nico.load("at_once", seed=0, observation="state")
    env.reset()
    timestep = env.step(np.zeros(4))
    assert (timestep.last(), timestep.reward, timestep.discount) == (True, 1.0, 0.0)
    nico.register()
    assert "at_once" in suite._DOMAINS["nico"].SUITE

    batch = NicoEnv(("grasp_glass", "at_once"), batch_size=[2], observation="state")
    state = batch.reset(TensorDict({"task": torch.tensor([0, 1])}, [2]))
    state = batch.step(state.set("action", torch.zeros(2, 4)))["next"]
    assert state["terminated"].flatten().tolist() == [False, True]
    assert state["reward"].flatten().tolist() == [0, 1]


@pytest.mark.parametrize(
    ("name", "task", "message"),
    [
        ("grasp_glass", AtOnce, r"^a task cannot be called 'grasp_glass': .* none of grasp_glass,"),
        ("at/once", AtOnce, r"^a task cannot be called 'at/once': take letters, digits and"),
        ("", AtOnce, r"^a task cannot be called '': take letters, digits and underscores"),
        ("juggle", object, r"^juggle must be a subclass of NicoTask, got <class 'object'>$"),
        ("juggle", "AtOnce", r"^juggle must be a subclass of NicoTask, got 'AtOnce'$"),
    ],
)
def test_what_is_no_task_is_not_added(name, task, message):
    before = dict(nico.TASKS)
    with pytest.raises(ValueError, match=message):
        nico.add_task(name, task)
    assert dict(nico.TASKS) == before


def test_an_own_task_may_be_defined_anew_and_the_list_not_be_written_to():
    class Never(nico.NicoTask):
        def succeeded(self, physics):
            return False

    nico.add_task("at_once", Never)
    assert nico.TASKS["at_once"] is Never
    with pytest.raises(TypeError):
        nico.TASKS["at_once"] = AtOnce  # pyright: ignore


def test_recorded_demonstrations_do_the_task(tmp_path):
    recorded = record_demonstrations(
        tmp_path,
        tasks=["push_white_to_green"],
        per_task=3,
        held_out_per_task=1,
        progress=False,
    )
    green, white = recorded["state"][..., 10:12], recorded["state"][..., 13:15]
    apart = torch.linalg.vector_norm(green - white, dim=-1)
    last = recorded["length"] - 1
    assert (apart[:, 0] > 0.1).all()
    assert (apart[range(3), last] < 0.08).all()  # boxes of 5 cm, turned
    assert recorded["task"].tolist() == [0, 0, 0]


def test_random_success_is_measured_by_name():
    rate = evaluate_random_policy(tasks=("grasp_glass", "at_once"), episodes=3, max_steps=2)
    assert rate.tolist() == [0, 1]


def test_success_of_an_own_task_is_counted_under_its_name(play):
    tasks = ("at_once", "push_green_to_white")
    run = play("run", bank_of(*nico.PAPER_TASKS, "at_once"), tasks=tasks, task_starts=(0, 3))

    assert json.loads((run / "config.json").read_text())["tasks"] == [*tasks]
    train, tests = rows(run / "train.csv"), rows(run / "eval.csv")
    assert {row["task"] for row in train} == {row["task"] for row in tests} == {*tasks}
    for row in [*train, *tests]:
        own = row["task"] == "at_once"
        assert (row["success"], row["steps"]) == (("1", "1") if own else ("0", "6"))
    assert {row["task"] for row in train if int(row["episode"]) <= 3} == {"at_once"}


def test_a_run_does_not_depend_on_tasks_that_are_not_in_it(play):
    known = bank_of(*nico.PAPER_TASKS)
    own = bank_of("at_once")
    runs = [play("alone", known), play("beside", known + own)]
    for name in ("train.csv", "eval.csv"):
        alone, beside = ((run / name).read_text() for run in runs)
        assert alone == beside


def test_a_run_is_not_resumed_with_other_demonstrations(make_config, tmp_path):
    config, bank = make_config("state", "oracle", tasks=("at_once",), task_starts=(0,)), bank_of
    parts = {"resume": True, "progress": False}
    with Trainer(config, tmp_path, bank=bank("at_once"), **parts) as trainer:
        trainer.run()
    with Trainer(config, tmp_path, bank=bank("at_once") + bank("grasp_glass"), **parts):
        pass  # The same, beside others that the run does not show.
    with pytest.raises(ValueError, match=r"holds a run with other settings \(bank is \w{64} there"):
        Trainer(config, tmp_path, bank=bank("at_once", n=7), **parts)


def test_a_module_may_be_renamed_between_a_run_and_its_resumption(make_config, tmp_path):
    config = make_config("state", "oracle", tasks=("at_once",), task_starts=(0,))
    for module in ("my_tasks", "renamed"):
        nico.add_task("at_once", type("Renamed", (AtOnce,), {"__module__": module}))
        bank = bank_of("at_once")
        with Trainer(config, tmp_path, bank=bank, resume=True, progress=False) as trainer:
            trainer.run()
        stored = json.loads((tmp_path / "config.json").read_text())
        assert stored["task_modules"] == {"at_once": module}


def test_a_bank_selects_and_labels_tasks_by_name():
    bank = bank_of("a", "b", "c", n=2)
    chosen = bank.for_tasks(["c", "a"])
    assert chosen.tasks == ("c", "a")
    assert chosen.task.tolist() == [1, 1, 0, 0]
    assert names_and_embeddings(chosen) == [("a", 0, 0), ("a", 0, 1), ("c", 2, 4), ("c", 2, 5)]
    assert chosen.train.tolist() == [False, True, True, True]
    assert names_and_embeddings(chosen.seen()) == names_and_embeddings(chosen)[1:]
    same = bank.for_tasks(bank.tasks)
    assert all(getattr(same, k).equal(getattr(bank, k)) for k in ("embedding", "task", "train"))
    with pytest.raises(ValueError, match=r"^the bank has no demonstration of 'd', only of a, b, c"):
        bank.for_tasks(["a", "d"])


def test_banks_are_joined_by_the_names_of_their_tasks():
    joined = bank_of("a", "b", n=1) + bank_of("c", "b", n=1)
    assert joined.tasks == ("a", "b", "c")
    assert names_and_embeddings(joined) == [("a", 0, 0), ("b", 1, 1), ("c", 0, 0), ("b", 1, 1)]


def test_a_bank_keeps_its_names_on_disk(tmp_path):
    path = tmp_path / "bank.safetensors"
    replace(bank_of("at_once", "grasp_glass"), encoder_id="abc").save(path)
    assert DemonstrationBank.load(path, encoder_id="abc").tasks == ("at_once", "grasp_glass")

    tensors, told = load_tensors(path)
    save_tensors(path, tensors, {key: value for key, value in told.items() if key != "tasks"})
    with pytest.raises(ValueError, match=r"its task names are missing\); make it again"):
        DemonstrationBank.load(path, encoder_id="abc")


def test_a_label_without_a_name_is_refused():
    with pytest.raises(ValueError, match=r"^a demonstration has task label 1, but tasks names"):
        replace(bank_of("a", "b"), tasks=("a",))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tasks": ("juggle",)}, r"^no NICO task 'juggle'; choose one of .* nico\.add_task$"),
        ({"tasks": ("at_once",) * 3}, r"^the task 'at_once' is named twice: name each once$"),
        ({"tasks": ("at_once",)}, "^task_starts must be one episode for each of the tasks"),
        (
            {"task_starts": (0,)},
            r"^task_starts must be one episode for each of the tasks, got \(0,\)",
        ),
    ],
)
def test_a_run_of_tasks_that_do_not_fit_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        RunConfig(**changes)


def test_a_run_without_demonstrations_of_a_task_is_refused_before_it_writes(make_config, tmp_path):
    config = make_config("state", "oracle", tasks=("at_once",), task_starts=(0,))
    with pytest.raises(ValueError, match=r"^the bank has no demonstration of 'at_once', only of"):
        Trainer(config, tmp_path / "run", bank=bank_of(*nico.PAPER_TASKS), progress=False)
    assert list(tmp_path.iterdir()) == []
