"""DemonstrationSource and TaskSchedule: which task and demonstration an episode starts with."""

import copy
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import (
    Compose,
    FrameSkipTransform,
    MultiAction,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    check_env_specs,
)

from bgpo_trl.transforms import DemonstrationSource, TaskSchedule
from tests.transforms.environment import (
    CONCURRENT,
    MockEnv,
    generators,
    make_bank,
    make_source,
    play,
)


def make(seeds=None, lengths=3, schedule=CONCURRENT, base=None):
    source = make_source(seeds, schedule)
    base = base or MockEnv(seeds, lengths)
    return TransformedEnv(base, Compose(StepCounter(50), source)), source


@pytest.mark.parametrize("cumulative", [True, False])
def test_tasks_that_start_together_are_available_together(cumulative):
    schedule = TaskSchedule((0, 0, 5), cumulative)
    expected = [[True, True, False], [cumulative, cumulative, True]]
    assert schedule.available(torch.tensor([4, 5])).tolist() == expected


@pytest.mark.parametrize("seeds", [None, [5, 6, 7]])
def test_the_demonstration_is_of_the_task_of_the_environment(seeds):
    env, source = make(seeds)
    check_env_specs(env)
    start = env.reset()
    assert {"task", "demo_embedding", "demo_index"} <= set(start.keys())
    steps, _ = play(env, 40, start)
    bank = make_bank()
    # The environment reports the task that it received at the reset.
    for data in (steps, steps["next"]):
        assert data["task"].equal(bank.task[data["demo_index"]])
        assert data["demo_embedding"].equal(bank.embedding[data["demo_index"]])
    assert steps["task"].unique().tolist() == [0, 1, 2]
    assert steps["demo_index"].equal(steps["next", "demo_index"])  # the same up to the end
    data = env.reset()
    for key in ("demo_embedding", "task", "demo_index"):
        data[key].zero_()  # does not reach the bank
    assert source._embedding.equal(bank.embedding) and source._task.equal(bank.task)


def test_draws_tasks_uniformly_then_their_demonstrations():
    # Task 0 has 8 demonstrations, task 1 has 2, task 2 is not presented.
    task = torch.tensor([0] * 8 + [1] * 2 + [2] * 2)
    bank, n = SimpleNamespace(embedding=torch.zeros(12, 32), task=task), 1000
    options = {"batch_size": [n], "generator": torch.Generator().manual_seed(0)}
    source = DemonstrationSource(bank, TaskSchedule((0, 0, 1)), **options)
    parts = Compose(StepCounter(50), source)
    drawn = TransformedEnv(MockEnv([0] * n), parts).reset()["demo_index"]
    counts = torch.bincount(drawn, minlength=12)
    expected = torch.tensor([n / 16] * 8 + [n / 4] * 2)
    assert counts[10:].sum() == 0
    assert ((counts[:10] - expected) / expected.sqrt()).abs().max() < 3.5


def test_every_row_follows_the_schedule_by_its_own_count():
    env, source = make([0, 1], [2, 6], TaskSchedule((0, 3, 5), cumulative=False))
    steps, _ = play(env, 36)
    assert source.episode.tolist() == [18, 6]
    for row, length in ((0, 2), (1, 6)):
        episode = torch.arange(36) // length
        assert steps["task"][row].equal((episode >= 3).long() + (episode >= 5).long())


def test_partial_reset_draws_for_the_rows_it_resets(monkeypatch):
    env, source = make([0, 1, 2], [2, 3, 4])
    drawn, draw = [], source._draw
    monkeypatch.setattr(source, "_draw", lambda rows: (drawn.append(rows.tolist()), draw(rows)))
    steps, _ = play(env, 4)
    assert drawn == [[True] * 3, [True, False, False], [False, True, False], [True, False, True]]
    # The running episodes keep theirs, the base environment included.
    length = torch.tensor([2, 3, 4])
    for t in range(1, 4):
        running = t % length != 0
        for key in ("demo_index", "task"):
            assert steps[key][running, t].equal(steps[key][running, t - 1])
    assert env.base_env.task_resets[1].tolist()[1:] == steps["task"][1:, 0].tolist()


def test_an_unfinished_episode_starts_again():
    env, source = make([0, 1], lengths=4)
    first = env.reset()["demo_index"]
    check_env_specs(env)
    collector = Collector(env, frames_per_batch=4, total_frames=4)
    assert source.episode.tolist() == [0, 0]
    assert env.reset()["demo_index"].equal(first)
    steps, _ = play(env, 3)
    assert env.reset()["demo_index"].equal(first)
    steps, data = play(env, 4)
    assert source.episode.tolist() == [1, 1]
    assert steps["demo_index"][:, 0].equal(first)
    assert not data["demo_index"].equal(first)
    collector.shutdown(close_env=False)


def test_reaches_environments_inside_a_serial_env():
    def single(length):
        return TransformedEnv(MockEnv(None, length), RewardSum())

    base = SerialEnv(2, [lambda: single(4), lambda: single(6)])
    env, source = make([0, 1], base=base)
    check_env_specs(env)
    steps, _ = play(env, 24)
    assert steps["task"].equal(make_bank().task[steps["demo_index"]])
    assert source.episode.tolist() == [6, 4]


def test_an_environment_that_ignores_the_task_is_refused():
    class Stubborn(MockEnv):
        def _reset(self, tensordict, **kwargs):
            return super()._reset(tensordict.exclude("task"), **kwargs)

    env, _ = make(list(range(9)), base=Stubborn([0] * 9))
    with pytest.raises(ValueError, match="did not take the task"):
        env.reset()


def test_a_schedule_that_runs_out_of_tasks_is_refused():
    def available(episode):
        return (episode < 2).unsqueeze(-1).expand(*episode.shape, 3)

    env, _ = make(lengths=3, schedule=SimpleNamespace(n_tasks=3, available=available))
    play(env, 5)  # an episode to its end, the next one not
    with pytest.raises(ValueError, match=r"no task .* available after 2 episodes: let its avail"):
        play(env, 3)


def test_bad_arguments_and_wrong_orders_are_refused():
    bank, both = make_bank(n_tasks=2), TaskSchedule((0, 0))
    one_missing = SimpleNamespace(embedding=bank.embedding, task=bank.task[1:])
    _, source = make([0, 1])
    options = {"batch_size": [3], "generator": generators([0, 1])}
    for call, message in (
        (lambda: DemonstrationSource(bank, CONCURRENT), "no demonstration of task 2"),
        (lambda: DemonstrationSource(one_missing, both), "shapes"),
        (lambda: DemonstrationSource(bank, both, **options), "a sequence of 3, one each"),
        (lambda: make([0, 1], base=MockEnv([0, 1, 2]))[0].reset(), "batch_size"),
        (lambda: source.seed_rows([1]), "1 seeds for 2 simulations"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    with pytest.raises(TypeError, match="append it to an environment"):
        source(TensorDict(batch_size=[2]))


def test_an_environment_wrapped_twice_counts_and_draws_in_the_same_source():
    """TorchRL puts a clone of the transform into the environment that it makes of the two."""
    env, source = make([3, 4])
    beside = copy.deepcopy(env)
    wrapped = TransformedEnv(env, RewardSum())
    source.seed_rows([7, 8])
    drawn = wrapped.rollout(7, break_when_any_done=False)["demo_index"]
    assert source.episode.tolist() == [2, 2]
    (alone,) = (t for t in beside.transform if isinstance(t, DemonstrationSource))
    assert alone.episode.tolist() == [0, 0]  # a deep copy is one by itself
    alone.seed_rows([7, 8])
    assert beside.rollout(7, break_when_any_done=False)["demo_index"].equal(drawn)


def test_embeddings_with_a_graph_are_constants():
    bank = make_bank()
    bank.embedding.requires_grad_()
    source = DemonstrationSource(bank, CONCURRENT)
    data = TransformedEnv(MockEnv(), Compose(StepCounter(50), source)).rollout(2)
    assert not data["demo_embedding"].requires_grad


def test_every_step_is_seen_once():
    def reset(*transforms):
        TransformedEnv(MockEnv(), Compose(StepCounter(50), *transforms)).reset()

    source = make_source()
    with pytest.raises(ValueError, match="put FrameSkipTransform before DemonstrationSource"):
        reset(source, FrameSkipTransform(2))
    with pytest.raises(ValueError, match="put MultiAction after DemonstrationSource"):
        reset(MultiAction(), make_source())
    reset(FrameSkipTransform(2), make_source())
    reset(make_source(), MultiAction())
