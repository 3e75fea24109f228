"""Films of what a run has learned."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from bgpo_trl.experiments import watch
from bgpo_trl.figures import gwr as growth
from bgpo_trl.runs.config_file import read_config
from bgpo_trl.runs.gwr_graphs import load_graphs
from suites import nico
from suites.nico.demonstrator import Demonstrator
from tests.helpers import contents

GREEN, RED = (0x00, 0x9E, 0x73), (0xD5, 0x5E, 0x00)


@pytest.fixture
def undemonstrated(monkeypatch):
    """Demonstrations that take no time and show nothing; films without a long last frame."""
    frames = np.random.default_rng(0).integers(256, size=(7, 32, 64, 3), dtype=np.uint8)
    monkeypatch.setattr(watch, "demonstrate", lambda tasks, *_: dict.fromkeys(tasks, frames))


@pytest.mark.parametrize("name", ["bgpo", "oracle"])
def test_a_film_has_its_files_and_leaves_the_run_unchanged(run_of, undemonstrated, tmp_path, name):
    run, out = run_of(name), tmp_path / "pictures"
    before = contents(run)
    with pytest.raises(ValueError, match="has no seed 5: choose one of 3, 8"):
        watch.watch(watch.WatchArguments(run, run_seed=5, out=out))
    assert not out.exists()
    printed = watch.watch(watch.WatchArguments(run, run_seed=8, out=out))
    assert contents(run) == before
    expected = {"film.gif", "film.png"} | ({"gwr_growth.png"} if name == "bgpo" else set())
    assert {path.name for path in out.iterdir()} == expected
    first, *outcomes, last = printed.splitlines()
    assert re.fullmatch(r"seed 8 after \d+ training episodes", first)
    assert [line.split(": ")[0] for line in outcomes] == [*nico.PAPER_TASKS]
    assert last == f"pictures: {out}"


def test_an_episode_has_the_frames_of_the_policys_actions():
    env = nico.load("push_green_to_white", seed=3)
    demonstrator, timestep, actions = Demonstrator(env, seed=3), env.reset(), []
    demonstrator.reset()
    frames = [timestep.observation["pixels"]]
    while not timestep.last():
        actions.append(demonstrator(timestep))
        timestep = env.step(actions[-1])
        frames.append(timestep.observation["pixels"])
    assert timestep.reward

    shown_to, seen, left = [], [], list(actions)
    algorithm = SimpleNamespace(max_steps=50)
    policy = SimpleNamespace(
        condition=lambda demonstration, task: shown_to.append((demonstration, task)),
        act=lambda frame: seen.append(frame) or left.pop(0),
        config=SimpleNamespace(algorithm=algorithm, scene="nico", spread=1.0),
    )
    episode = watch.play(policy, "push_green_to_white", np.stack(frames[:2]), 3)
    assert shown_to == [(episode.demonstration, "push_green_to_white")]
    np.testing.assert_array_equal(episode.seen, frames)
    np.testing.assert_array_equal(seen, frames[:-1])
    assert episode.view.shape == (len(frames), 128, 192, 3)
    assert len(np.unique(episode.view, axis=0)) > 1
    assert episode.outcome == f"success after {len(actions)} steps"

    left[:], algorithm.max_steps = actions, 4
    early = watch.play(policy, "push_green_to_white", episode.demonstration, 3)
    assert early.outcome == "no success after 4 steps"


@pytest.mark.parametrize(("success", "color"), [(True, GREEN), (False, RED)])
def test_the_frame_of_an_episode_has_the_color_of_its_outcome_from_its_end_on(success, color):
    black = np.zeros((4, 128, 192, 3), np.uint8)
    episode = watch.Episode("lift", black[:, :32, :64], black[:2, :32, :64], black[:2], success)
    pictures = watch.compose([episode])
    assert len(pictures) == 4 + 2 * 10  # those of the demonstration; the last one is held
    framed = [int((np.abs(p - np.array(color)) < 9).all(-1).sum()) for p in pictures.astype(int)]
    assert framed[0] == 0
    assert min(framed[1:]) > 2 * 4 * 2 * (128 + 192)  # two pictures with borders of 4 pixels


def test_the_growth_figure_labels_nodes_by_the_tasks_presented_so_far(run_of, bank, monkeypatch):
    run, drawn = run_of("bgpo"), []
    config = read_config(run / "config.json")[0]
    monkeypatch.setattr(growth, "plot_gwr_growth", lambda *given: drawn.append(given))
    monkeypatch.setattr(growth, "save_figure", lambda figure, path: drawn.append(path))
    assert growth.draw_growth(run, config, bank)
    (graphs, counts, names), path = drawn
    assert path == run / "figures" / "gwr_growth.png"
    assert names == nico.PAPER_TASKS
    assert list(graphs) == list(load_graphs(run / "gwr"))
    seen = bank.seen()
    for episode, (weights, edges, tasks) in graphs.items():
        presented = [t for t, start in enumerate(config.task_starts) if start < episode]
        matches = [[] for _ in weights]
        for phi, task in zip(seen.embedding, seen.task.tolist(), strict=True):
            if task in presented:
                matches[int((weights - phi).norm(dim=-1).argmin())].append(task)
        for matched, task in zip(matches, tasks.tolist(), strict=True):
            assert task == (max(range(3), key=matched.count) if matched else -1)
        assert edges.max() < len(weights) == counts[0][episode - 1]
    assert [len(count) for count in counts] == [config.episodes] * 2
    assert not growth.draw_growth(run_of("oracle"), config, bank)
