"""The steps of demonstrations in eight bits, and the bank that carries them."""

from dataclasses import replace

import pytest
import torch

from bgpo_trl.data.bank import DemonstrationBank, DemonstrationSteps
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.encoders.train import make_bank
from bgpo_trl.experiments import make_data
from bgpo_trl.experiments.arguments import MakeBankArguments
from bgpo_trl.files.tensor_file import load_tensors, save_tensors
from suites import nico
from tests.algorithms.playing import assert_same
from tests.helpers import noise_demonstrations

LENGTH = torch.tensor([4, 0, 2, 6, 0])


@pytest.fixture
def padded():
    generator = torch.Generator().manual_seed(0)
    latent = torch.randn(5, 6, 64, generator=generator) * 2
    return latent, torch.rand(5, 5, 4, generator=generator) * 2 - 1


@pytest.fixture
def steps(padded):
    return DemonstrationSteps.of(*padded, LENGTH, padded[0][..., :2])  # those are the joints


def frames(steps, row):
    return torch.arange(int(steps.length[row])) + steps.first[row]


def test_no_number_is_off_by_more_than_half_a_code(steps, padded):
    latent, action = padded
    assert steps.latent.dtype == steps.action.dtype == torch.int8
    assert len(steps.latent) == LENGTH.sum()
    for row, length in enumerate(LENGTH.tolist()):
        kept, exact = steps.latents(frames(steps, row)), latent[row, :length].clamp(-5.08, 5.08)
        assert kept.shape == (length, 64)
        assert ((kept - exact).abs() <= 0.5 / 25 + 1e-6).all()
        moves = frames(steps, row)[: max(length - 1, 0)]
        error = steps.actions(moves) - action[row, : len(moves)]
        assert (error.abs() <= 0.5 / 127 + 1e-6).all()
    assert latent.abs().max() > 5.08  # so that some are clipped


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
@pytest.mark.parametrize(("latent", "row"), [(True, 3), (False, 3), (True, 1), (False, 1)])
def test_latents_and_actions_are_finite_in_what_is_kept(padded, value, latent, row):
    """Rounded to whole numbers, NaN would be 0. Of demonstration 1, nothing is kept."""
    (padded[0] if latent else padded[1])[row, 4, 0] = value
    if row == 1:
        DemonstrationSteps.of(*padded, LENGTH)
        return
    with pytest.raises(ValueError, match="latents or actions of demonstrations are not finite"):
        DemonstrationSteps.of(*padded, LENGTH)


def test_steps_that_do_not_fit_together_are_refused(steps):
    for changes in (
        {"latent": torch.zeros(12, 64)},
        {"first": torch.zeros(4, dtype=torch.int64)},
        {"first": torch.tensor([0, 4, 4, -1, 12])},
        {"length": torch.tensor([4, 0, 2, 7, 0])},
        {"length": LENGTH.float()},
    ):
        with pytest.raises(ValueError, match="of its steps do not match"):
            replace(steps, **changes)


# ---- in the bank


@pytest.fixture
def with_steps(steps):
    embedding = torch.rand(5, 32, generator=torch.Generator().manual_seed(1))
    task = torch.tensor([0, 1, 2, 0, 1])
    return DemonstrationBank(
        embedding, task, LENGTH > 0, nico.PAPER_TASKS, steps=steps, encoder_id="x"
    )


def test_steps_and_names_of_tasks_go_with_their_demonstrations(with_steps):
    steps, every = with_steps.steps, with_steps.tasks
    for part, rows, tasks in (
        (with_steps.seen(), [0, 2, 3], every),
        (with_steps.held_out(), [1, 4], every),
        (with_steps.of_task(0), [0, 3], every),
        (with_steps.for_tasks(every[2::-2]), [0, 2, 3], every[2::-2]),
        (with_steps.for_tasks(every[2:]) + with_steps.seen(), [2, 0, 2, 3], (every[2], *every[:2])),
    ):
        assert part.embedding.equal(with_steps.embedding[rows])
        assert part.train.equal(with_steps.train[rows])
        assert part.tasks == tasks
        names = [every[label] for label in with_steps.task[rows]]
        assert [tasks[label] for label in part.task] == names
        for row, origin in enumerate(rows):
            ours, theirs = frames(part.steps, row), frames(steps, origin)
            assert part.steps.latents(ours).equal(steps.latents(theirs))
            assert part.steps.actions(ours).equal(steps.actions(theirs))
    assert (with_steps + replace(with_steps, steps=None)).steps is None
    with pytest.raises(ValueError, match="no demonstration of 'juggle'"):
        with_steps.for_tasks(["juggle"])
    with pytest.raises(ValueError, match="task label 1"):
        replace(with_steps, tasks=every[:1])


def test_the_halves_of_the_held_out_ones_take_turns_and_are_all_of_them(bank):
    """Task by task, in whatever order they are."""
    sorted_by_task = bank._select(bank.task.argsort(stable=True))
    for one in (bank, sorted_by_task, bank.for_tasks(bank.tasks[::-1])):
        halves = [one.held_out(part) for part in ("validation", "test")]
        assert [len(half.task) for half in halves] == [6, 6]
        for task in range(3):
            every = one.of_task(task).held_out().embedding
            for first, half in enumerate(halves):
                assert half.of_task(task).embedding.equal(every[first::2])


def test_few_demonstrations_are_the_first_of_each_task(bank):
    few, seen = bank.seen(3), bank.seen()
    for task in range(len(bank.tasks)):
        assert few.of_task(task).embedding.equal(seen.of_task(task).embedding[:3])
    assert bank.seen(8).embedding.equal(seen.embedding)  # all that there are
    with pytest.raises(ValueError, match="fewer than 9 demonstrations of 'grasp_glass'"):
        bank.seen(9)


def test_steps_of_other_demonstrations_are_refused(with_steps, tmp_path):
    with pytest.raises(ValueError, match="steps of 3 demonstrations, but embeddings of 5"):
        replace(with_steps, steps=with_steps.seen().steps)
    with_steps.save(tmp_path / "bank")
    tensors, meta = load_tensors(tmp_path / "bank")
    meta.pop("sha256", None)
    short = {f"steps.{key}": tensors[f"steps.{key}"][1:].clone() for key in ("first", "length")}
    floats = {"steps.latent": tensors["steps.latent"].float()}
    for damage in (short, floats, {"steps.other": torch.zeros(5)}):
        save_tensors(tmp_path / "damaged", tensors | damage, meta)
        with pytest.raises(ValueError, match=r"damaged or not a bank .* make it again"):
            DemonstrationBank.load(tmp_path / "damaged", encoder_id="x")


def test_names_of_tasks_differ_and_are_printable(with_steps):
    for wrong in (("a", "a", "b"), ("a", " b", "c"), ("a", "b\n", "c"), ("a", "", "c")):
        with pytest.raises(ValueError, match=r"named twice|printable"):
            replace(with_steps, tasks=wrong)


@pytest.fixture
def dataset():
    return noise_demonstrations([5, 3, 4])


def test_a_bank_is_made_of_what_the_encoders_see(encoders, dataset):
    length = dataset["length"]
    inferred, recorded = (
        make_bank(encoders, dataset, tasks=nico.PAPER_TASKS, actions=actions)
        for actions in ("inferred", "recorded")
    )
    assert inferred.steps.length.tolist() == [5, 3, 0]  # nothing of what is held out
    with_actions = replace(inferred.steps, action=recorded.steps.action)
    assert_same(vars(with_actions), vars(recorded.steps))
    for row, n in ((0, 5), (1, 3)):
        pixels = dataset["pixels"][row, :n]
        latent = encoders.frame_network.latent(pixels)
        phi = encoders.lae.encode(latent[None], length[row : row + 1])[0]
        torch.testing.assert_close(inferred.embedding[row], phi, rtol=1e-4, atol=1e-5)
        kept = inferred.steps.latents(frames(inferred.steps, row))
        torch.testing.assert_close(kept, latent.clamp(-5.08, 5.08), rtol=0, atol=0.021)
        moves = frames(inferred.steps, row)[:-1]
        action = encoders.inverse(latent[None], length[row : row + 1])[0, : n - 1]
        torch.testing.assert_close(inferred.steps.actions(moves), action, rtol=0, atol=0.005)
        exact = dataset["action"][row, : n - 1]
        torch.testing.assert_close(recorded.steps.actions(moves), exact, rtol=0, atol=0.005)


@pytest.mark.parametrize(("chosen", "noise"), [(0.05, 0.05), (0.0, 0.0), (None, 0.2)])
def test_a_bank_has_the_noise_that_suits_its_steps(encoders, dataset, monkeypatch, chosen, noise):
    """Or the usual one, if nothing can be told."""
    given = []
    monkeypatch.setattr(
        "bgpo_trl.encoders.train.choose_noise", lambda bank: given.append(bank) or chosen
    )
    bank = make_bank(encoders, dataset, tasks=nico.PAPER_TASKS)
    assert bank.noise == noise
    assert_same(vars(given[0].steps), vars(bank.steps))


def test_the_banks_steps_are_those_of_its_embeddings():
    """phi anew from the latents of the shipped bank: rounding moves it hardly."""
    encoders, bank = load_pretrained()
    seen = bank.seen()
    assert bool((seen.steps.length >= 2).all())
    assert not bank.held_out().steps.length.any()
    rows = torch.arange(0, len(seen.task), 61)
    length = seen.steps.length[rows]
    inside = torch.arange(51) < length.unsqueeze(-1)
    frame = (seen.steps.first[rows].unsqueeze(-1) + torch.arange(51)).where(inside, 0)
    phi = encoders.lae.encode(seen.steps.latents(frame), length)
    distance = (phi - seen.embedding[rows]).norm(dim=-1)
    assert distance.max() < 0.03  # of about 3 between two demonstrations


def test_the_identity_is_that_of_the_demonstrations(bank, tmp_path):
    path, tasks = tmp_path / "bank.safetensors", nico.PAPER_TASKS[1:]
    some = replace(bank.for_tasks(tasks), encoder_id="abc")
    some.save(path)
    assert DemonstrationBank.load(path, encoder_id="abc").identity == some.identity
    assert bank.for_tasks(tasks).identity == some.identity
    # Bank and selection have the frames of all tasks in memory.
    renamed = replace(some, tasks=("juggle", "dance"))
    assert renamed.identity == some.identity
    others = [
        bank,
        bank.for_tasks(tasks[::-1]),
        replace(some, steps=None),
        replace(some, embedding=some.embedding + 1e-6),
        replace(some, train=~some.train),
        replace(some, noise=0.1),
    ]
    assert len({some.identity, *(other.identity for other in others)}) == 7


def test_the_command_keeps_the_names_of_the_tasks(tmp_path, encoders, monkeypatch):
    nico.add_task("push_again", nico.TASKS["push_green_to_white"])
    folder, out = tmp_path / "recorded", tmp_path / "bank.safetensors"
    record_demonstrations(
        folder, tasks=["push_again"], per_task=2, held_out_per_task=1, progress=False
    )
    monkeypatch.setattr(make_data, "load_representation", lambda path, scene: encoders)
    arguments = MakeBankArguments(dataset=folder, out=out)
    for _ in range(2):  # A bank may be made anew, another file is kept.
        make_data.bank(arguments)
    kept = tmp_path / "encoders.safetensors"
    save_tensors(kept, {"weight": torch.zeros(2)}, {})
    with pytest.raises(ValueError, match="is no bank, and is kept"):
        make_data.bank(replace(arguments, out=kept))
    found = DemonstrationBank.load(out, encoder_id=encoders.identity)
    assert found.tasks == ("push_again",)
    assert found.task.tolist() == [0, 0]
    assert found.train.tolist() == [True, False]


def test_a_bank_remembers_encoders_and_scene_and_joins_none_of_others(with_steps, tmp_path):
    path, unknown = tmp_path / "bank.safetensors", replace(with_steps, encoder_id=None)
    assert with_steps.scene is None
    one = replace(with_steps, scene="nico 1", noise=0.05)
    one.save(path)
    loaded = DemonstrationBank.load(path, encoder_id="x")
    for part in (loaded, loaded.seen(), loaded.for_tasks(loaded.tasks[1:]), loaded + one):
        assert (part.encoder_id, part.scene, part.noise) == ("x", "nico 1", 0.05)
    assert loaded.identity == one.identity
    with pytest.raises(ValueError, match="set encoder_id"):
        unknown.save(path)
    for other in (unknown, replace(with_steps, encoder_id="xyz")):
        with pytest.raises(ValueError, match="embedded by the encoders x, the other by"):
            with_steps + other
    with pytest.raises(ValueError, match="shows the scene nico 1, the other nico 2"):
        loaded + replace(with_steps, scene="nico 2")
