"""Films of what a run has learned."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from bgpo_trl.experiments import watch
from bgpo_trl.figures import gwr as growth
from bgpo_trl.runs.config_file import read_config
from bgpo_trl.runs.gwr_graphs import load_graphs
from suites import nico
from suites.nico.demonstrator import Demonstrator
from tests.helpers import contents

GRAY, GREEN, RED = (0x99, 0x99, 0x99), (0x00, 0x9E, 0x73), (0xD5, 0x5E, 0x00)


@pytest.fixture
def undemonstrated(monkeypatch):
    """Demonstrations that take no time and show nothing; films without a long last frame."""
    frames = np.random.default_rng(0).integers(256, size=(7, 32, 64, 3), dtype=np.uint8)
    monkeypatch.setattr(watch, "demonstrate", lambda tasks, *_: dict.fromkeys(tasks, frames))
    monkeypatch.setattr(watch, "_FPS", 1)


@pytest.mark.parametrize("name", ["bgpo", "oracle"])
def test_a_film_has_its_files_and_leaves_the_run_unchanged(run_of, undemonstrated, tmp_path, name):
    run, out = run_of(name), tmp_path / "pictures"
    before = contents(run)
    printed = watch.watch(watch.WatchArguments(run, run_seed=8, out=out))
    assert contents(run) == before
    expected = {"film.gif", "film.png"} | ({"gwr_growth.png"} if name == "bgpo" else set())
    assert {path.name for path in out.iterdir()} == expected
    first, *outcomes, last = printed.splitlines()
    assert re.fullmatch(r"seed 8 after \d+ training episodes", first)
    for task, line in zip(nico.PAPER_TASKS, outcomes, strict=True):
        assert line.startswith((f"{task}: no success after 6 steps", f"{task}: success after "))
    assert last == f"pictures: {out}"
    with Image.open(out / "film.gif") as gif:
        assert gif.size == (760, 494)


def shown(seed):
    """Returns the actions that solve a task from a start, and what is seen on the way."""
    env = nico.load("push_green_to_white", seed=seed)
    demonstrator = Demonstrator(env, seed=seed)
    timestep, actions = env.reset(), []
    demonstrator.reset()
    frames = [timestep.observation["pixels"]]
    while not timestep.last():
        actions.append(demonstrator(timestep))
        timestep = env.step(actions[-1])
        frames.append(timestep.observation["pixels"])
    assert timestep.reward
    return actions, np.stack(frames)


def test_an_episode_has_the_frames_of_the_policys_actions():
    actions, frames = shown(3)
    watched, seen, left = [], [], list(actions)

    def act(frame):
        seen.append(frame)
        return left.pop(0)

    policy = SimpleNamespace(
        condition=lambda demonstration, task: watched.append((demonstration, task)),
        act=act,
        config=SimpleNamespace(algorithm=SimpleNamespace(max_steps=50), scene="nico", spread=1.0),
    )
    episode = watch.play(policy, "push_green_to_white", frames[:2], 3)
    ((demonstration, task),) = watched
    assert demonstration is episode.demonstration
    assert task == "push_green_to_white"
    np.testing.assert_array_equal(episode.seen, frames)
    np.testing.assert_array_equal(np.stack(seen), frames[:-1])
    assert episode.view.shape == (len(frames), 128, 192, 3)
    assert len(np.unique(episode.view, axis=0)) > 1
    assert episode.outcome == f"success after {len(actions)} steps"

    left[:], policy.config.algorithm.max_steps = actions, 4
    assert watch.play(policy, "push_green_to_white", frames, 3).outcome == (
        "no success after 4 steps"
    )


def episode(n_shown, n_seen, success):
    """Frames of one shade each: from 90 in the demonstration, from 180 in what is seen."""

    def shades(first, n, *shape):
        frames = np.zeros((n, *shape, 3), np.uint8)
        return frames + np.arange(first, first + 20 * n, 20, np.uint8)[:, None, None, None]

    return watch.Episode(
        "grasp_glass",
        shades(90, n_shown, 32, 64),
        shades(180, n_seen, 32, 64),
        shades(10, n_seen, 128, 192),
        success,
    )


def test_panels_show_demonstration_view_and_room_framed_by_the_outcome():
    pictures = watch.compose([episode(4, 2, True), episode(2, 3, False)])
    assert len(pictures) == 4 + 2 * 10
    assert (pictures[4:] == pictures[3]).all()
    top = (4 + 18, 4 + 18 + 162)  # of the border of the two rows
    left = (8, 280, 552)  # of the borders of the three panels
    shade = [[[picture[y + 60, x + 90, 0] for x in left] for y in top] for picture in pictures[:4]]
    expected = [
        [[90, 180, 10], [90, 180, 10]],
        [[110, 200, 30], [110, 200, 30]],
        [[130, 200, 30], [110, 220, 50]],
        [[150, 200, 30], [110, 220, 50]],
    ]
    np.testing.assert_allclose(shade, expected, atol=9)  # There are only so many colors.
    border = [[[picture[y + 1, x + 1] for x in left] for y in top] for picture in pictures[:4]]
    going, won, lost = [GRAY] * 3, [GRAY, GREEN, GREEN], [GRAY, RED, RED]
    expected = [[going, going], [won, going], [won, lost], [won, lost]]
    np.testing.assert_allclose(border, expected, atol=9)


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


def test_a_seed_that_the_run_does_not_have_is_refused(run_of, tmp_path):
    with pytest.raises(ValueError, match="has no seed 5: choose one of 3, 8"):
        watch.watch(watch.WatchArguments(run_of("bgpo"), run_seed=5, out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()
